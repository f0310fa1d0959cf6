// The text beside the canvas: lists that are the map for those who do not see it, and what is known of what was chosen.

const ROWS = 150; // of a list, until more are asked for

function h(tag, attributes, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes || {})) {
    if (name.startsWith('on')) element.addEventListener(name.slice(2), value);
    else if (value === true) element.setAttribute(name, '');
    else if (value !== false && value !== null && value !== undefined) element.setAttribute(name, value);
  }
  element.append(...children.flat().filter((child) => child !== null && child !== undefined && child !== ''));
  return element;
}

function number(value, digits = 2) {
  return Number.isFinite(value) ? value.toFixed(digits).replace('-', '\u2212') : '\u2013';
}

function count(value) { return value.toLocaleString('en'); }

function plural(n, one, many = one + 's') { return `${count(n)} ${n === 1 ? one : many}`; }

function dateOf(seconds) {
  return seconds > 0 ? new Date(1000 * seconds).toISOString().replace('T', ' ').slice(0, 16) + ' UTC' : '';
}

const COMPASS = ['east', 'north-east', 'north', 'north-west', 'west', 'south-west', 'south', 'south-east'];

function facing(normal) {
  const heading = ((90 - Math.atan2(normal[1], normal[0]) * 180 / Math.PI) % 360 + 360) % 360;
  const rank = Math.round(Math.atan2(normal[1], normal[0]) / (Math.PI / 4));
  return `${COMPASS[(rank + 8) % 8]} (${heading.toFixed(0)}\u00b0 from north)`;
}

// Latitude and longitude of a point of the map, by the radii of the ellipsoid's curvature at its origin.
function degreesOf(origin, x, y) {
  const a = 6378137, e2 = 0.00669437999014, phi = origin[0] * Math.PI / 180;
  const w = Math.sqrt(1 - e2 * Math.sin(phi) ** 2), n = a / w, m = n * (1 - e2) / (w * w);
  return [origin[0] + y / (m + origin[2]) * 180 / Math.PI, origin[1] + x / ((n + origin[2]) * Math.cos(phi)) * 180 / Math.PI];
}

class Panel {
  constructor(viewer) {
    this.viewer = viewer;
    this.model = viewer.model;
    this.shapes = this.model.head.shapes.map((name) => name.replace('_', ' '));
    this.types = { '-1': 'unknown', ...this.model.head.lane_types };
    this.detail = h('section', { class: 'cmv-detail', 'aria-live': 'polite', 'aria-label': 'what was chosen', tabindex: '-1' });
    this.list = h('div', { class: 'cmv-list' });
    this.tabs = h('div', { class: 'cmv-tabs', role: 'tablist', 'aria-label': 'lists' });
    this.element = h('aside', { class: 'cmv-side', 'aria-label': 'signs, markers and drives' }, this.detail, this.tabs, this.list);
    this.kinds = this.listed();
    this.filter = '';
    this.kind = null;
    for (const kind of this.kinds) {
      this.tabs.append(h('button', {
        role: 'tab', type: 'button', 'data-kind': kind.name, onclick: () => this.show(kind.name),
      }, `${kind.title} ${count(kind.rows.length)}`));
    }
    if (this.kinds.length) this.show(this.kinds[0].name);
    this.welcome();
  }

  // What lists there are: columns of a row, and the words it is found by.
  listed() {
    const { model } = this, kinds = [];
    const survey = model.has('sign.true');
    if (model.signs.length) {
      kinds.push({
        name: 'sign', title: 'Signs', rows: model.signs, head: ['sign', 'shape', 'code', 'sigma [m]', ...(survey ? ['error [m]'] : [])],
        cells: (s) => [s.id, this.shapes[s.shape], s.code, number(sigmaOf(s), 3), ...(survey ? [this.errorText(s)] : [])],
      });
    }
    if (model.lanes.length) {
      kinds.push({
        name: 'lane', title: 'Markers', rows: model.lanes, head: ['marker', 'type', 'length [m]', 'drives'],
        cells: (l) => [l.id, this.types[l.type], number(lengthOf(l), 0), l.journeys],
      });
    }
    if (model.drives.length) {
      kinds.push({
        name: 'drive', title: 'Drives', rows: model.drives.map((drive, row) => ({ ...drive, row })),
        head: ['drive', 'way [m]', 'frames', model.kind === 'run' ? 'bias [m]' : 'vehicle'],
        cells: (d) => [d.id, number(d.length_m, 0), count(d.frames),
          model.kind === 'run' ? (d.bias ? number(Math.hypot(...d.bias)) : '\u2013') : d.vehicle || ''],
      });
    }
    return kinds;
  }

  errorText(sign) {
    if (sign.true === -1) return 'duplicate';
    return sign.true < 0 ? 'not surveyed' : number(sign.errorM, 3);
  }

  show(name, most = ROWS) {
    this.kind = this.kinds.find((kind) => kind.name === name);
    for (const tab of this.tabs.children) tab.setAttribute('aria-selected', String(tab.dataset.kind === name));
    this.fill(most);
  }

  search(text) {
    this.filter = text.trim().toLowerCase();
    if (this.kind) this.fill(ROWS);
    return this.found || [];
  }

  fill(most) {
    const kind = this.kind, words = this.filter.split(/\s+/).filter(Boolean);
    this.found = kind.rows.filter((row) => {
      const text = kind.cells(row).join(' ').toLowerCase();
      return words.every((word) => text.includes(word));
    });
    const rows = this.found.slice(0, most).map((row) => h('tr', {
      'data-row': row.row, class: 'cmv-row', onclick: () => this.viewer.choose({ kind: kind.name, row: row.row }, { fly: true }),
    }, kind.cells(row).map((cell, k) => h(k ? 'td' : 'th', k ? { class: /[a-z]/i.test(cell) ? 'cmv-word' : null } : { scope: 'row' },
      k ? String(cell) : h('button', { type: 'button', class: 'cmv-link', title: String(cell) }, String(cell))))));
    const told = this.filter ? `${plural(this.found.length, 'row')} of ${count(kind.rows.length)}` : `all ${kind.title.toLowerCase()}`;
    const table = h('table', {}, h('caption', {}, `${kind.title}: ${told}`),
      h('thead', {}, h('tr', {}, kind.head.map((text) => h('th', { scope: 'col' }, text)))), h('tbody', {}, rows));
    this.list.replaceChildren(table);
    if (this.found.length > most) {
      this.list.append(h('button', { type: 'button', class: 'cmv-more', onclick: () => this.fill(4 * most) },
        `show more, ${count(this.found.length - most)} are left`));
    }
    this.mark();
  }

  // Marks the row of what is chosen.
  mark() {
    const chosen = this.viewer.state.chosen;
    for (const row of this.list.querySelectorAll('.cmv-row')) {
      const is = Boolean(chosen && this.kind.name === chosen.kind && Number(row.dataset.row) === chosen.row);
      row.classList.toggle('cmv-is', is);
      row.querySelector('button').setAttribute('aria-pressed', String(is));
    }
  }

  // Of everything, as long as nothing is chosen.
  welcome() {
    const { model } = this, { head } = model, parts = [];
    if (model.signs.length || model.lanes.length) {
      parts.push(plural(model.signs.length, 'sign'), plural(model.lanes.length, 'lane marker'));
    }
    if (model.drives.length) parts.push(plural(model.drives.length, 'drive'));
    if (!parts.length) parts.push(plural(model.survey.length, 'surveyed sign'), plural(model.surveyLanes.length, 'surveyed marker'));
    const told = [h('p', {}, parts.join(', ') + '.')];
    if (head.drawn && head.drawn[0] < head.drawn[1]) {
      const what = model.kind === 'run' ? 'detections of its signs' : 'frames';
      told.push(h('p', { class: 'cmv-soft' }, `${count(head.drawn[0])} of ${count(head.drawn[1])} ${what} are in this file, evenly chosen; the numbers are of all.`));
    }
    for (const note of head.notes) told.push(h('p', { class: 'cmv-soft' }, note));
    told.push(h('p', { class: 'cmv-soft' }, 'Click a sign, a marker or a drive. Keys: arrows move, + and \u2212 zoom, 3 tilts, ',
      'n and p step through the list, / searches, 0 shows everything, Esc lets go.'));
    this.detail.replaceChildren(h('h2', {}, 'At a glance'), ...told);
  }

  // What is known of what was chosen.
  tell(chosen) {
    if (!chosen) this.welcome();
    else if (chosen.kind === 'sign') this.tellSign(this.model.signs[chosen.row]);
    else if (chosen.kind === 'lane') this.tellLane(this.model.lanes[chosen.row]);
    else if (chosen.kind === 'drive') this.tellDrive(chosen.row);
    else this.tellFrame(this.model.frames[chosen.row]);
    if (chosen && this.kind && this.kind.name !== chosen.kind && this.kinds.some((k) => k.name === chosen.kind)) this.show(chosen.kind);
    this.mark();
    this.detail.scrollTop = 0;
  }

  numbers(pairs) {
    return h('dl', {}, pairs.filter(([, text]) => text !== null && text !== '').flatMap(
      ([name, text]) => [h('dt', {}, name), h('dd', {}, text)]));
  }

  tellSign(sign) {
    const { head } = this.model, [lat, lon] = degreesOf(head.origin, sign.x, sign.y), c = sign.covariance;
    const s = head.shared_covariance || new Array(9).fill(0), root = (v) => number(Math.sqrt(Math.max(v, 0)), 3);
    const pairs = [
      ['shape', this.shapes[sign.shape]], ['code', sign.code || 'unknown'],
      ['size', `${number(sign.w, 3)} \u00d7 ${number(sign.h, 3)} m`],
      ['east, north, up', `${number(sign.x)}, ${number(sign.y)}, ${number(sign.z)} m`],
      ['lat, lon', `${lat.toFixed(7)}, ${lon.toFixed(7)}`],
      ['above the ground', `${number(sign.z - sign.ground)} m`],
      ['faces', facing(sign.axes[2])],
      ['sigma e, n, u', `${root(c[0])}, ${root(c[3])}, ${root(c[5])} m`],
      ['without shared part', head.shared_covariance && s[0] > 0 ? `${root(c[0] - s[0])}, ${root(c[3] - s[4])}, ${root(c[5] - s[8])} m` : ''],
      ['rests on', sign.journeys ? `${plural(sign.observations, 'detection')} of ${plural(sign.journeys, 'drive')}` : ''],
      ['seen', sign.first ? `${dateOf(sign.first)} to ${dateOf(sign.last)}` : ''],
      ['confidence', number(sign.confidence, 3)],
    ];
    if (sign.true !== undefined) {
      const e = sign.error;
      pairs.push(['survey', sign.true >= 0 ? head.survey_id[sign.true] : this.errorText(sign)]);
      if (sign.true >= 0) pairs.push(['error e, n, u', `${[0, 1, 2].map((k) => number(e[k], 3)).join(', ')} m; ${number(sign.errorM, 3)} m in all`]);
    }
    if (sign.before) {
      const move = ['x', 'y', 'z'].map((k) => sign[k] - sign.before[k]);
      pairs.push(['adjusted by', `${move.map((v) => number(v, 3)).join(', ')} m`]);
    }
    this.detail.replaceChildren(h('h2', {}, sign.id), this.numbers(pairs), ...this.seenOf(sign));
  }

  // The drives that saw a sign, and their detections in the image.
  seenOf(sign) {
    const { model } = this, pairs = model.pairs.get(sign.row) || [], seen = model.seen.get(sign.row) || [];
    if (!pairs.length) return [];
    const rows = pairs.map((pair) => h('tr', {}, h('th', { scope: 'row' },
      h('i', { class: 'cmv-dot', style: `background:${driveColor(pair.drive)}` }),
      h('button', { type: 'button', class: 'cmv-link', onclick: () => this.viewer.choose({ kind: 'drive', row: pair.drive }) }, model.drives[pair.drive].id)),
    h('td', {}, pair.used), h('td', {}, pair.givenUp), h('td', {}, pair.near), h('td', {}, pair.used ? number(pair.rms) : '\u2013')));
    const drives = h('div', { class: 'cmv-scroll' }, h('table', {}, h('caption', {}, 'Its drives'),
      h('thead', {}, h('tr', {}, ['drive', 'counted', 'given up', 'near only', 'rms [px]'].map((t) => h('th', { scope: 'col' }, t)))),
      h('tbody', {}, rows)));
    if (!seen.length) return [drives];
    return [drives, ...this.pictures(seen)];
  }

  pictures(seen) {
    const { viewer } = this, painter = viewer.painter, canvas = h('canvas', { class: 'cmv-picture', role: 'img' });
    const picture = new Picture(canvas, painter), told = h('p', { class: 'cmv-soft' });
    const factor = h('select', { 'aria-label': 'residuals, times', onchange: () => draw() }, [1, 5, 20].map(
      (k) => h('option', { value: k, selected: k === 5 }, `residuals \u00d7 ${k}`)));
    let at = -1;
    const draw = () => {
      const one = seen[at] || null;
      viewer.state.detection = one;
      viewer.redraw();
      if (!one) {
        picture.all(seen, null);
        told.textContent = `${plural(seen.length, 'detection')} in the image, by colour of the drive; red: given up, dotted: only lies on it.`;
        canvas.setAttribute('aria-label', told.textContent);
      } else {
        picture.one(one, Number(factor.value));
        const size = one.residual ? Math.max(...Array.from({ length: one.corners }, (_, k) => Math.hypot(one.residual[2 * k], one.residual[2 * k + 1]))) : NaN;
        const way = Math.hypot(...one.from);
        told.textContent = `${this.model.drives[one.drive].id}, frame ${one.frame}${way ? `, ${way.toFixed(0)} m away` : ''}: ${KINDS[one.state]}`
          + (one.state === 0 ? '' : ` (${one.state === 1 ? 'an outlier for the adjustment' : one.fate})`)
          + (Number.isFinite(size) ? `; largest residual ${size.toFixed(2)} px. Line: detected, dashes: projected.` : '; no residual.');
        canvas.setAttribute('aria-label', told.textContent);
      }
      for (const row of table.querySelectorAll('tr[data-row]')) row.classList.toggle('cmv-is', Number(row.dataset.row) === at);
    };
    const pick = (k) => { at = at === k ? -1 : k; draw(); };
    const rows = seen.map((one, k) => h('tr', { 'data-row': k, class: 'cmv-row', onclick: () => pick(k) },
      h('th', { scope: 'row' }, h('i', { class: 'cmv-dot', style: `background:${driveColor(one.drive)}` }),
        h('button', { type: 'button', class: 'cmv-link' }, `frame ${one.frame}`)),
      h('td', {}, number(Math.hypot(...one.from), 0)),
      h('td', {}, one.residual ? number(Math.sqrt(one.residual.reduce((sum, r) => sum + r * r, 0) / one.corners)) : '\u2013'),
      h('td', { class: one.state ? 'cmv-bad' : '' }, one.state === 2 ? one.fate : KINDS[one.state])));
    const table = h('div', { class: 'cmv-scroll' }, h('table', {}, h('caption', {}, `Detections, ${count(seen.length)} of them in this file`),
      h('thead', {}, h('tr', {}, ['frame', 'away [m]', 'rms [px]', 'fate'].map((t) => h('th', { scope: 'col' }, t)))), h('tbody', {}, rows)));
    viewer.later(draw);
    this.redrawPicture = draw;
    return [h('div', { class: 'cmv-bar' }, factor, h('button', { type: 'button', onclick: () => { at = -1; draw(); } }, 'all at once')), canvas, told, table];
  }

  tellLane(lane) {
    const sigma = Array.from(lane.sigma).sort((a, b) => a - b);
    this.detail.replaceChildren(h('h2', {}, lane.id), this.numbers([
      ['type', this.types[lane.type]], ['length', `${number(lengthOf(lane), 1)} m`],
      ['sigma sideways', sigma.length ? `${number(sigma[0], 3)} to ${number(sigma[sigma.length - 1], 3)} m` : ''],
      ['rests on', lane.journeys ? `${plural(lane.observations, 'detection')} of ${plural(lane.journeys, 'drive')}` : ''],
      ['seen', lane.first_s ? `${dateOf(lane.first_s)} to ${dateOf(lane.last_s)}` : ''],
      ['confidence', number(lane.confidence, 3)],
    ]));
  }

  tellDrive(row) {
    const drive = this.model.drives[row], sigma = drive.bias_sigma;
    const bias = drive.bias && drive.bias.map((v, k) => number(v, 3) + (sigma ? ` \u00b1 ${number(sigma[k], 3)}` : '')).join(', ') + ' m';
    const own = [];
    for (const pairs of this.model.pairs.values()) own.push(...pairs.filter((pair) => pair.drive === row));
    const sum = (name) => own.reduce((n, pair) => n + pair[name], 0);
    const frames = this.model.framesOf.get(row);
    this.detail.replaceChildren(h('h2', {}, h('i', { class: 'cmv-dot', style: `background:${driveColor(row)}` }), drive.id),
      drive.remark ? h('p', { class: 'cmv-bad' }, drive.remark) : '', this.numbers([
        ['vehicle', drive.vehicle || ''], ['way', `${number(drive.length_m, 0)} m`], ['frames', count(drive.frames)],
        ['driven', drive.begin_s ? `${dateOf(drive.begin_s)}, ${plural(drive.end_s - drive.begin_s, 'second')}` : ''],
        ['bias e, n, u', bias || ''],
        ['detections of signs', own.length ? `${count(sum('used'))} counted, ${count(sum('givenUp'))} given up, ${count(sum('near'))} only lie on one` : ''],
      ]), frames ? h('button', { type: 'button', class: 'cmv-more', onclick: () => this.viewer.choose({ kind: 'frame', row: frames[0].row }, { fly: true }) },
        `go through its ${count(frames.length)} frames`) : '');
  }

  tellFrame(frame) {
    const { viewer, model } = this, canvas = h('canvas', { class: 'cmv-picture', role: 'img' });
    const own = model.framesOf.get(frame.drive), place = own.indexOf(frame);
    const go = (k) => viewer.choose({ kind: 'frame', row: own[Math.min(Math.max(k, 0), own.length - 1)].row }, { follow: true });
    const slider = h('input', {
      type: 'range', min: 0, max: own.length - 1, value: place, 'aria-label': 'frame', oninput: (event) => go(Number(event.target.value)),
    });
    const told = `frame ${frame.number}: ${plural(frame.signs.length, 'sign')}, ${plural(frame.lanes.length, 'lane marker')}`;
    canvas.setAttribute('aria-label', told);
    const keeps = this.detail.contains(document.activeElement) && document.activeElement.type === 'range';
    this.detail.replaceChildren(h('h2', {}, h('i', { class: 'cmv-dot', style: `background:${driveColor(frame.drive)}` }), model.drives[frame.drive].id),
      h('div', { class: 'cmv-bar' }, h('button', { type: 'button', 'aria-label': 'frame before', onclick: () => go(place - 1) }, '\u2190'), slider,
        h('button', { type: 'button', 'aria-label': 'next frame', onclick: () => go(place + 1) }, '\u2192')),
      canvas, this.numbers([['frame', `${frame.number}, ${number(frame.ms / 1000, 2)} s`], ['detected', told.split(': ')[1]],
        ['codes', frame.signs.map((sign) => sign.code || this.shapes[sign.shape]).join(', ')],
        ['east, north, up', `${number(frame.x)}, ${number(frame.y)}, ${number(frame.z)} m`],
        ['looks', facing(frame.axes[2])],
        ['sigma as stated', frame.sigma.some((v) => v) ? Array.from(frame.sigma, (v) => number(v)).join(', ') + ' m' : 'unknown']]));
    if (keeps) slider.focus();
    const draw = () => new Picture(canvas, viewer.painter).frame(frame);
    viewer.later(draw);
    this.redrawPicture = draw;
  }
}

function sigmaOf(sign) {
  const c = sign.covariance;
  return Math.sqrt(Math.max(c[0] + c[3] + c[5], 0) / 3);
}

function lengthOf(line) {
  let way = 0;
  const p = line.points;
  for (let k = 3; k < p.length; k += 3) way += Math.hypot(p[k] - p[k - 3], p[k + 1] - p[k - 2], p[k + 2] - p[k - 1]);
  return way;
}
