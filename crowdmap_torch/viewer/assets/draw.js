// Draws a model through a view. Lines of one style are one path; what is out of sight or smaller than a pixel is left out.

const PLATES = { // face, rim and letters by shape, as most signs of that shape have them
  octagon: ['#c3202f', '#ffffff', '#ffffff'],
  triangle: ['#ffffff', '#c3202f', '#111111'],
  inverted_triangle: ['#ffffff', '#c3202f', '#111111'],
  diamond: ['#f2c230', '#1c1c1c', '#111111'],
  pentagon: ['#d3e04a', '#1c1c1c', '#111111'],
  rectangle: ['#ffffff', '#2b3442', '#111111'],
};
const FAR_LABELS = 4; // pixels a metre from which signs are named
const DASH_M = 3; // a dash of a dashed marker, and the gap behind it
const DASHES_M = 250; // as far as dashes are told apart in 3D
const RAYS = 24; // lines of sight of a sign
const FAR_PLATES = 1.2; // and from which they are drawn as plates
const DRIVES = ['#8e5bd0', '#1b9e9e', '#c25a97', '#7a8f1f', '#b5702a', '#4b79c9', '#5f9e4a', '#a8554b'];

function driveColor(number) { return DRIVES[number % DRIVES.length]; }

class Painter {
  constructor(canvas, model, view, state) {
    this.canvas = canvas;
    this.ctx = canvas.getContext('2d', { alpha: false });
    this.model = model;
    this.view = view;
    this.state = state;
    this.widths = new Map();
  }

  readTheme(element) {
    const style = getComputedStyle(element), names = ['back', 'ink', 'soft', 'line', 'map', 'survey', 'before', 'bad',
      'marker', 'curb', 'grid', 'ground'];
    this.theme = Object.fromEntries(names.map((name) => [name, style.getPropertyValue('--cmv-' + name).trim()]));
  }

  draw() {
    const { ctx, view, state, model, theme } = this, on = state.layers, ratio = state.ratio;
    ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
    ctx.globalAlpha = 1;
    ctx.fillStyle = theme.back;
    ctx.fillRect(0, 0, view.width, view.height);
    this.box = view.reach();
    this.taken = new Set();
    if (view.solid) this.horizon();
    if (on.grid) this.grid();
    if (on.sigma) this.laneSigma();
    if (on.survey) this.lines(model.surveyLanes, theme.survey, view.solid ? 4 : 5, 0.35);
    if (on.given) this.paths(model.given, [4, 4], 0.9);
    if (on.drives) this.paths(model.paths, [], 0.75);
    if (on.before) this.lines(model.lanesBefore, theme.before, 1.2, 0.8);
    if (on.lanes) this.lanes();
    if (on.frames) this.frames();
    if (on.ellipses) this.ellipses();
    if (on.survey) this.surveySigns();
    if (on.before) this.beforeSigns();
    if (on.errors) this.errors();
    if (on.rays) this.rays();
    if (on.signs) this.signs();
    if (on.biases) this.biases();
    this.selection();
  }

  horizon() {
    const { ctx, view, theme } = this;
    const far = view.onScreen(view.inEye(view.eye[0] + 1e5 * view.forward[0], view.eye[1] + 1e5 * view.forward[1], view.z));
    ctx.fillStyle = theme.ground;
    ctx.fillRect(0, Math.max(0, Math.min(far[1], view.height)), view.width, view.height);
  }

  grid() {
    const { ctx, view, theme } = this, step = 10 ** Math.ceil(Math.log10(60 / view.scale));
    const reach = view.solid ? 40 * step : Infinity, [a, b, c, d] = this.box;
    const x0 = Math.max(a, view.x - reach), x1 = Math.min(c, view.x + reach);
    const y0 = Math.max(b, view.y - reach), y1 = Math.min(d, view.y + reach);
    ctx.beginPath();
    for (let x = Math.ceil(x0 / step) * step; x <= x1; x += step) this.segment([x, y0, view.z], [x, y1, view.z]);
    for (let y = Math.ceil(y0 / step) * step; y <= y1; y += step) this.segment([x0, y, view.z], [x1, y, view.z]);
    this.stroke(theme.grid, 1, 1);
  }

  stroke(color, width, alpha, dash = []) {
    const { ctx } = this;
    ctx.strokeStyle = color;
    ctx.lineWidth = width;
    // Of thin lines nobody sees how they are joined, and round joins take half of the time.
    ctx.lineJoin = width < 2 ? 'bevel' : 'round';
    ctx.lineCap = width < 2 ? 'butt' : 'round';
    ctx.globalAlpha = alpha;
    ctx.setLineDash(dash);
    ctx.stroke();
    ctx.globalAlpha = 1;
    ctx.setLineDash([]);
  }

  // Adds a segment to the path, cut off before the eye.
  segment(p, q) {
    const { ctx, view } = this;
    if (!view.solid) {
      const a = view.project(...p), b = view.project(...q);
      ctx.moveTo(a[0], a[1]);
      ctx.lineTo(b[0], b[1]);
      return;
    }
    let a = view.inEye(...p), b = view.inEye(...q);
    if (a[2] < NEAR && b[2] < NEAR) return;
    if (a[2] < NEAR) a = cutAt(b, a);
    if (b[2] < NEAR) b = cutAt(a, b);
    a = view.onScreen(a);
    b = view.onScreen(b);
    ctx.moveTo(a[0], a[1]);
    ctx.lineTo(b[0], b[1]);
  }

  // Adds to the path what of a line can be seen, as finely as a pixel shows.
  trace(line) {
    const { ctx, view } = this, points = line.points, m = view.m;
    let level = TOLERANCES.length - 1;
    while (level && TOLERANCES[level] * view.scale > 0.7) level--;
    let joined = false;
    for (const piece of line.pieces) {
      const b = piece.box;
      if (!view.sees(b)) {
        joined = false;
        continue;
      }
      if (view.solid) {
        this.traceSolid(points, piece.levels[Math.min(level, this.nearLevel(b))]);
        continue;
      }
      const kept = piece.levels[level];
      for (let k = joined ? 1 : 0; k < kept.length; k++) {
        const x = points[3 * kept[k]], y = points[3 * kept[k] + 1];
        const px = m[0] * x + m[1] * y + m[4], py = m[2] * x + m[3] * y + m[5];
        if (k || joined) ctx.lineTo(px, py);
        else ctx.moveTo(px, py);
      }
      joined = true;
    }
  }

  // How coarse a piece may be at its distance from the eye.
  nearLevel(b) {
    const scale = this.view.focal / Math.max(boxWay(b, this.view.eye), 1);
    let level = TOLERANCES.length - 1;
    while (level && TOLERANCES[level] * scale > 0.7) level--;
    return level;
  }

  traceSolid(points, kept) {
    const { ctx, view } = this;
    let before = null;
    for (const k of kept) {
      const p = view.inEye(points[3 * k], points[3 * k + 1], points[3 * k + 2]);
      if (p[2] >= NEAR) {
        if (before && before[2] < NEAR) {
          const cut = view.onScreen(cutAt(p, before));
          ctx.moveTo(cut[0], cut[1]);
        }
        const q = view.onScreen(p);
        if (before) ctx.lineTo(q[0], q[1]);
        else ctx.moveTo(q[0], q[1]);
      } else if (before && before[2] >= NEAR) {
        const cut = view.onScreen(cutAt(before, p));
        ctx.lineTo(cut[0], cut[1]);
      }
      before = p;
    }
  }

  lines(lines, color, width, alpha, dash) {
    if (!lines.length) return;
    this.ctx.beginPath();
    for (const line of lines) this.trace(line);
    this.stroke(color, width, alpha, dash);
  }

  lanes() {
    const { model, theme, view } = this, s = view.scale;
    const wide = Math.min(Math.max(0.15 * s, 1.4), view.solid ? 3 : 7);
    const dash = DASH_M * s > 5 && !view.solid ? [DASH_M * s, DASH_M * s] : [];
    const of = (type) => model.lanes.filter((lane) => lane.type === type);
    this.byType = this.byType || { '-1': of(-1), 0: of(0), 1: of(1), 2: of(2), 3: of(3) };
    this.lines(this.byType[3], theme.curb, wide * 1.3, 1);
    this.lines(this.byType[2], theme.marker, wide * 2.6, 1);
    if (wide > 1.5) this.lines(this.byType[2], view.solid ? theme.ground : theme.back, wide * 0.9, 1);
    this.lines(this.byType[0], theme.marker, wide, 1);
    if (view.solid) this.dashesSolid(this.byType[1], wide);
    else this.lines(this.byType[1], theme.marker, wide, dash.length ? 1 : 0.6, dash);
    this.lines(this.byType[-1], theme.soft, wide, 0.8);
  }

  // In perspective dashes are as long as on the road, and far away a paler line.
  dashesSolid(lines, wide) {
    const { ctx, view, theme } = this, far = [];
    ctx.beginPath();
    for (const line of lines) {
      for (const piece of line.pieces) {
        const b = piece.box;
        if (!view.sees(b)) continue;
        if (boxWay(b, view.eye) > DASHES_M) far.push([line.points, piece.levels[this.nearLevel(b)]]);
        else this.dashes(line.points, piece);
      }
    }
    this.stroke(theme.marker, wide, 1);
    ctx.beginPath();
    for (const [points, kept] of far) this.traceSolid(points, kept);
    this.stroke(theme.marker, wide, 0.5);
  }

  dashes(points, piece) {
    const { view } = this;
    let phase = 0;
    for (let k = piece.a; k < piece.b; k++) {
      const p = points.subarray(3 * k, 3 * k + 3), q = points.subarray(3 * k + 3, 3 * k + 6);
      const way = Math.hypot(q[0] - p[0], q[1] - p[1], q[2] - p[2]), at = (l) => [0, 1, 2].map((i) => p[i] + l / way * (q[i] - p[i]));
      for (let l = -phase; l < way; l += 2 * DASH_M) {
        const a = Math.max(l, 0), b = Math.min(l + DASH_M, way);
        if (b <= a) continue;
        const from = at(a);
        if (Math.hypot(from[0] - view.eye[0], from[1] - view.eye[1]) < DASHES_M) this.segment(from, at(b));
      }
      phase = (phase + way) % (2 * DASH_M);
    }
  }

  // A band of 95 % to either side, where that is wider than the line.
  laneSigma() {
    const { ctx, model, theme, view } = this, factor = 1.96 * this.state.magnify;
    if (view.scale * factor * 0.5 < 1) return;
    ctx.fillStyle = theme.map;
    ctx.globalAlpha = 0.16;
    for (const lane of model.lanes) {
      for (const piece of lane.pieces) {
        if (!view.sees(piece.box)) continue;
        this.fillPolygon(bandOf(lane, piece, factor));
      }
    }
    ctx.globalAlpha = 1;
  }

  // Fills a polygon in space, unless a part of it is behind the eye.
  fillPolygon(corners) {
    const { ctx, view } = this, seen = corners.map((p) => view.project(...p));
    if (view.solid && seen.some((p) => p[2] < NEAR)) return false;
    ctx.beginPath();
    seen.forEach((p, k) => (k ? ctx.lineTo(p[0], p[1]) : ctx.moveTo(p[0], p[1])));
    ctx.closePath();
    ctx.fill();
    return true;
  }

  paths(paths, dash, alpha) {
    const chosen = this.state.drive;
    for (const path of paths) {
      const is = chosen === path.row;
      const faint = chosen !== null && !is ? 0.25 : 1;
      this.lines([path], driveColor(path.row), is ? 3 : 1.3, alpha * faint, dash);
    }
  }

  // Where a thing is on the screen, or null where that is out of sight.
  place(thing, z = thing.z) {
    const { view } = this, p = view.project(thing.x, thing.y, z);
    if (view.solid && (p[2] < NEAR || p[2] > view.far)) return null;
    return p[0] > -60 && p[1] > -60 && p[0] < view.width + 60 && p[1] < view.height + 60 ? p : null;
  }

  local(p) { return this.view.solid ? this.view.focal / p[2] : this.view.scale; }

  signs() {
    const { model, view, theme, ctx } = this;
    const shown = [];
    for (const sign of model.signs) {
      const p = this.place(sign);
      if (p) shown.push([sign, p]);
    }
    if (view.solid) {
      shown.sort((a, b) => b[1][2] - a[1][2]);
      for (const [sign, p] of shown) this.plateSolid(sign, p, theme.map);
      this.names(shown.slice().reverse());
      return;
    }
    if (view.scale < FAR_PLATES) {
      const size = view.scale < 0.3 ? 3 : 5, wrong = shown.filter(([sign]) => sign.true === -2);
      this.dots(shown, theme.map, size);
      this.dots(wrong, theme.bad, size);
      return;
    }
    this.platesAbove(model.signs, theme.map, 3);
    if (view.scale >= FAR_LABELS) for (const [sign, p] of shown) this.icon(sign, p);
    this.names(shown);
  }

  // Squares of `size` pixels, one where several would cover one another.
  dots(shown, color, size) {
    const { ctx } = this, taken = new Set();
    ctx.fillStyle = color;
    for (const [, p] of shown) {
      const x = Math.round(p[0] - size / 2), y = Math.round(p[1] - size / 2), key = x * 65536 + y;
      if (taken.has(key)) continue;
      taken.add(key);
      ctx.fillRect(x, y, size, size);
    }
  }

  // From above a plate is a stroke as wide as the plate, with another one to where it faces.
  platesAbove(signs, color, width) {
    const { ctx, view } = this;
    ctx.beginPath();
    for (const sign of signs) {
      const p = this.place(sign);
      if (!p) continue;
      const half = Math.max(sign.w / 2, 5 / view.scale), face = Math.max(1, 9 / view.scale);
      const [r, , n] = sign.axes;
      this.segment([sign.x - half * r[0], sign.y - half * r[1], sign.z], [sign.x + half * r[0], sign.y + half * r[1], sign.z]);
      this.segment([sign.x, sign.y, sign.z], [sign.x + face * n[0], sign.y + face * n[1], sign.z]);
    }
    this.stroke(color, width, 1);
  }

  // The shape behind the plate, upright for the reader.
  icon(sign, p) {
    const { ctx, model, view } = this, name = model.head.shapes[sign.shape], [face, rim] = PLATES[name];
    const q = view.project(sign.x - 16 / view.scale * sign.axes[2][0], sign.y - 16 / view.scale * sign.axes[2][1], sign.z);
    const t = model.head.templates[sign.shape], longest = Math.max(sign.w, sign.h);
    ctx.beginPath();
    for (let k = 0; k < t.length; k += 2) {
      const x = q[0] + 17 * t[k] * sign.w / longest, y = q[1] - 17 * t[k + 1] * sign.h / longest;
      if (k) ctx.lineTo(x, y);
      else ctx.moveTo(x, y);
    }
    ctx.closePath();
    ctx.fillStyle = face;
    ctx.fill();
    this.stroke(rim, 1.6, 1);
    sign.iconAt = q;
  }

  // Codes beside signs, as many as have room.
  names(shown) {
    const { ctx, view, theme, state } = this;
    if (!state.layers.names) return;
    ctx.font = '12px system-ui, sans-serif';
    ctx.textBaseline = 'middle';
    ctx.lineWidth = 3;
    for (const [sign, p] of shown) {
      const scale = this.local(p);
      if (scale < FAR_LABELS) continue;
      const text = sign.code || sign.id;
      const at = view.solid ? [p[0], p[1] - 0.5 * sign.h * scale - 10] : [sign.iconAt[0] + 14, sign.iconAt[1]];
      if (!this.widths.has(text)) this.widths.set(text, ctx.measureText(text).width);
      const width = this.widths.get(text), left = view.solid ? at[0] - width / 2 : at[0];
      if (!this.room(left, at[1] - 8, width, 16)) continue;
      ctx.strokeStyle = theme.back;
      ctx.strokeText(text, left, at[1]);
      ctx.fillStyle = theme.ink;
      ctx.fillText(text, left, at[1]);
    }
  }

  // Whether nothing was written there; it is taken then.
  room(x, y, w, h) {
    const cells = [];
    for (let i = Math.floor(x / 16); i <= Math.floor((x + w) / 16); i++) {
      for (let j = Math.floor(y / 16); j <= Math.floor((y + h) / 16); j++) cells.push(i * 10007 + j);
    }
    if (cells.some((cell) => this.taken.has(cell))) return false;
    cells.forEach((cell) => this.taken.add(cell));
    return true;
  }

  plateSolid(sign, p, color) {
    const { ctx, view, theme, model } = this, scale = this.local(p), high = sign.h * scale;
    if (high < 1) {
      if (high > 0.25) {
        ctx.fillStyle = color;
        ctx.fillRect(p[0] - 1, p[1] - 1, 2, 2);
      }
      return;
    }
    ctx.beginPath();
    this.segment([sign.x, sign.y, sign.z - sign.h / 2], [sign.x, sign.y, sign.ground]);
    this.stroke(theme.soft, Math.max(0.06 * scale, 0.7), 0.9);
    const name = model.head.shapes[sign.shape], [face, rim, ink] = PLATES[name], n = sign.axes[2], e = view.eye;
    const front = n[0] * (e[0] - sign.x) + n[1] * (e[1] - sign.y) + n[2] * (e[2] - sign.z) > 0;
    ctx.fillStyle = front ? face : '#8b939e';
    if (!this.fillPolygon(sign.corners)) return;
    this.stroke(front ? rim : '#646c77', Math.min(Math.max(0.05 * scale, 0.8), 6), 1);
    if (front && sign.code && sign.w * scale > 26) this.writeOn(sign, ink);
  }

  // The code on the face of a plate, as it stands.
  writeOn(sign, ink) {
    const { ctx, view, state } = this, text = sign.code.split(':').pop();
    const [r, u] = sign.axes, at = (a, b) => view.project(...[0, 1, 2].map(
      (i) => [sign.x, sign.y, sign.z][i] + a * r[i] + b * u[i]));
    const o = at(0, 0), x = at(0.1, 0), y = at(0, -0.1);
    const size = Math.min(0.35 * sign.h, 1.1 * sign.w / Math.max(text.length, 2));
    ctx.save();
    const k = state.ratio * size / 1.0; // letters are 10 px high in a frame of a tenth of a metre
    ctx.setTransform(k * (x[0] - o[0]), k * (x[1] - o[1]), k * (y[0] - o[0]), k * (y[1] - o[1]), state.ratio * o[0], state.ratio * o[1]);
    ctx.font = '10px system-ui, sans-serif';
    ctx.textAlign = 'center';
    ctx.textBaseline = 'middle';
    ctx.fillStyle = ink;
    ctx.fillText(text, 0, 0);
    ctx.restore();
  }

  // Outlines as surveyed; from above circles, from far those alone that the map lacks.
  surveySigns() {
    const { ctx, model, theme, view } = this, far = !view.solid && view.scale < FAR_PLATES, dots = [];
    ctx.beginPath();
    for (const sign of model.survey) {
      const p = this.place(sign);
      if (!p) continue;
      if (view.solid && this.local(p) * 0.3 < 1) continue;
      if (view.solid) sign.corners.forEach((c, k) => this.segment(c, sign.corners[(k + 1) % sign.corners.length]));
      if (far && sign.found) dots.push([sign, p]);
      else if (!view.solid || !sign.corners.length) {
        ctx.moveTo(p[0] + 7, p[1]);
        ctx.arc(p[0], p[1], 7, 0, 2 * Math.PI);
      }
    }
    this.stroke(theme.survey, far ? 1.2 : 2, 1);
    this.dots(dots, theme.survey, 5);
  }

  beforeSigns() {
    const { ctx, model, theme, view } = this;
    if (!view.solid && view.scale >= FAR_PLATES) this.platesAbove(model.before, theme.before, 2);
    ctx.beginPath();
    for (const sign of model.before) {
      const p = this.place(sign);
      if (!p) continue;
      if (view.solid) sign.corners.forEach((c, k) => this.segment(c, sign.corners[(k + 1) % sign.corners.length]));
      else if (view.scale < FAR_PLATES) ctx.rect(p[0] - 2, p[1] - 2, 4, 4);
    }
    this.stroke(theme.before, 1.6, 1);
  }

  // From the true sign to the map's, errors magnified.
  errors() {
    const { ctx, model, theme, state } = this;
    ctx.beginPath();
    for (const sign of model.signs) {
      const p = sign.true >= 0 && this.place(sign), e = sign.error, k = state.magnify;
      if (!p || k * sign.errorM * this.local(p) < 1) continue;
      const from = [sign.x - e[0], sign.y - e[1], sign.z - e[2]];
      this.segment(from, from.map((v, i) => v + k * e[i]));
    }
    this.stroke(theme.bad, 2.2, 1);
  }

  ellipses() {
    const { ctx, model, theme, view, state } = this;
    ctx.beginPath();
    for (const sign of model.signs) {
      const p = this.place(sign);
      if (!p) continue;
      const e = state.shared ? sign.ellipse : sign.ownEllipse, k = state.magnify;
      if (k * e.a * this.local(p) < 2) continue;
      const [r, u] = [[Math.cos(e.angle), Math.sin(e.angle)], [-Math.sin(e.angle), Math.cos(e.angle)]];
      if (!view.solid) {
        const angle = -(e.angle - view.turn), a = k * e.a * view.scale, b = k * e.b * view.scale;
        ctx.moveTo(p[0] + a * Math.cos(angle), p[1] + a * Math.sin(angle));
        ctx.ellipse(p[0], p[1], a, b, angle, 0, 2 * Math.PI);
        continue;
      }
      let before = null;
      for (let j = 0; j <= 24; j++) {
        const c = k * e.a * Math.cos(j * Math.PI / 12), s = k * e.b * Math.sin(j * Math.PI / 12);
        const q = [sign.x + c * r[0] + s * u[0], sign.y + c * r[1] + s * u[1], sign.z];
        if (before) this.segment(before, q);
        before = q;
      }
    }
    this.stroke(theme.map, 1.2, 0.8);
  }

  // What is to be added to the given positions of a drive, from the middle of its way.
  biases() {
    const { ctx, model, theme, state } = this;
    for (const path of model.paths) {
      const drive = model.drives[path.row];
      if (!drive.bias || !path.count || (state.drive !== null && state.drive !== path.row)) continue;
      const k = 3 * Math.floor(path.count / 2), to = Array.from(path.points.subarray(k, k + 3));
      const from = to.map((v, i) => v - state.magnify * drive.bias[i]);
      ctx.beginPath();
      this.segment(from, to);
      this.stroke(driveColor(path.row), 3, 1);
      const p = this.place({ x: to[0], y: to[1], z: to[2] });
      if (!p) continue;
      ctx.fillStyle = driveColor(path.row);
      ctx.beginPath();
      ctx.arc(p[0], p[1], 4, 0, 7);
      ctx.fill();
      const q = this.place({ x: from[0], y: from[1], z: from[2] });
      if (q && Math.hypot(p[0] - q[0], p[1] - q[1]) > 30 && this.room(p[0] + 7, p[1] - 8, 60, 16)) {
        ctx.font = '12px system-ui, sans-serif';
        ctx.fillStyle = theme.ink;
        ctx.fillText(Math.hypot(...drive.bias).toFixed(2) + ' m', p[0] + 8, p[1]);
      }
    }
  }

  frames() {
    const { ctx, model, view, state } = this;
    if (view.scale < 0.5 && !view.solid) return;
    const least = view.solid ? 0 : 4;
    for (const frame of model.frames) {
      if (state.drive !== null && frame.drive !== state.drive) continue;
      const p = this.place(frame);
      if (!p) continue;
      const r = Math.max(this.local(p) * 0.15, 1.5);
      if (r < 0.5) continue;
      ctx.fillStyle = driveColor(frame.drive);
      ctx.fillRect(p[0] - r, p[1] - r, 2 * r, 2 * r);
      const s = state.magnify * frame.sigma[0] * this.local(p), t = state.magnify * frame.sigma[1] * this.local(p);
      if (state.layers.ellipses && !view.solid && s > least) {
        ctx.beginPath();
        ctx.ellipse(p[0], p[1], s, t, -(0 - view.turn), 0, 7);
        this.stroke(driveColor(frame.drive), 1, 0.25);
      }
    }
  }

  selection() {
    const { ctx, model, view, theme, state } = this, chosen = state.chosen;
    if (!chosen) return;
    if (chosen.kind === 'lane') {
      this.lines([model.lanes[chosen.row]], theme.map, 4, 0.9);
      return;
    }
    if (chosen.kind === 'drive') return;
    const thing = chosen.kind === 'sign' ? model.signs[chosen.row] : model.frames[chosen.row];
    if (chosen.kind === 'frame') this.frustum(thing);
    const p = this.place(thing);
    if (!p) return;
    ctx.beginPath();
    ctx.arc(p[0], p[1], Math.max(15, view.solid ? 0.9 * Math.max(thing.h || 0.5, thing.w || 0.5) * this.local(p) : 15), 0, 7);
    this.stroke(theme.map, 2.5, 1);
  }

  // From the chosen sign to where it was seen from: the detection that is looked at, or some of each drive.
  rays() {
    const { ctx, model, theme, state } = this, chosen = state.chosen;
    if (!chosen || chosen.kind !== 'sign') return;
    const { x, y, z } = model.signs[chosen.row], seen = model.seen.get(chosen.row) || [];
    const every = Math.max(1, Math.ceil(seen.length / RAYS));
    seen.forEach((one, k) => {
      const is = state.detection === one;
      if (!one.from.some((v) => v !== 0) || !(is || (!state.detection && k % every === 0))) return;
      ctx.beginPath();
      this.segment([x, y, z], [x + one.from[0], y + one.from[1], z + one.from[2]]);
      this.stroke(one.state ? theme.bad : driveColor(one.drive), is ? 2 : 1, is ? 1 : 0.5);
    });
  }

  // Where the camera of a frame looks.
  frustum(frame) {
    const { ctx, theme } = this, [r, d, f] = frame.axes, at = [frame.x, frame.y, frame.z];
    const corner = (a, b) => at.map((v, i) => v + 6 * f[i] + a * r[i] + b * d[i]);
    const corners = [corner(-3.5, -2), corner(3.5, -2), corner(3.5, 2), corner(-3.5, 2)];
    ctx.beginPath();
    corners.forEach((c, k) => {
      this.segment(at, c);
      this.segment(c, corners[(k + 1) % 4]);
    });
    this.stroke(theme.map, 1.5, 1);
  }

  // The nearest thing within reach of a pixel: a sign, a frame, a drive or a marker.
  pick(px, py, reach) {
    const { model, state } = this, on = state.layers;
    let best = null, least = reach;
    const tryPoint = (kind, thing, p) => {
      const way = p ? Math.hypot(p[0] - px, p[1] - py) : Infinity;
      if (way < least) [least, best] = [way, { kind, row: thing.row }];
    };
    if (on.signs) {
      for (const sign of model.signs) {
        tryPoint('sign', sign, this.place(sign));
        if (!this.view.solid && this.view.scale >= FAR_LABELS) tryPoint('sign', sign, sign.iconAt);
      }
    }
    if (on.frames && !best) {
      for (const frame of model.frames) {
        if (state.drive === null || frame.drive === state.drive) tryPoint('frame', frame, this.place(frame));
      }
    }
    if (best) return best;
    least = 0.6 * reach;
    const near = (kind, lines) => {
      for (const line of lines) {
        const way = this.wayTo(line, px, py);
        if (way < least) [least, best] = [way, { kind, row: line.row }];
      }
    };
    if (on.lanes) near('lane', model.lanes);
    if (on.drives) near('drive', model.paths);
    return best;
  }

  wayTo(line, px, py) {
    let least = Infinity;
    for (const piece of line.pieces) {
      if (!this.view.sees(piece.box)) continue;
      for (let k = piece.a; k < piece.b; k++) {
        const p = this.view.project(...line.points.subarray(3 * k, 3 * k + 3));
        const q = this.view.project(...line.points.subarray(3 * k + 3, 3 * k + 6));
        if (p[2] < NEAR || q[2] < NEAR) continue;
        const dx = q[0] - p[0], dy = q[1] - p[1], length = dx * dx + dy * dy || 1;
        const t = Math.min(Math.max(((px - p[0]) * dx + (py - p[1]) * dy) / length, 0), 1);
        least = Math.min(least, Math.hypot(p[0] + t * dx - px, p[1] + t * dy - py));
      }
    }
    return least;
  }
}

// How far a box is from a point, on the ground.
function boxWay(b, p) {
  return Math.hypot(Math.max(b[0] - p[0], p[0] - b[2], 0), Math.max(b[1] - p[1], p[1] - b[3], 0));
}

// The point at the near plane on the way from one that is seen to one that is not.
function cutAt(seen, hidden) {
  const t = (seen[2] - NEAR) / (seen[2] - hidden[2]);
  return [0, 1, 2].map((i) => seen[i] + t * (hidden[i] - seen[i]));
}

// Points to either side of a piece of a marker, a few sigmas away.
function bandOf(lane, piece, factor) {
  const left = [], right = [], p = lane.points;
  for (let k = piece.a; k <= piece.b; k++) {
    const a = Math.max(k - 1, piece.a), b = Math.min(k + 1, piece.b);
    const dx = p[3 * b] - p[3 * a], dy = p[3 * b + 1] - p[3 * a + 1], n = Math.hypot(dx, dy) || 1;
    const s = factor * lane.sigma[k] / n;
    left.push([p[3 * k] - dy * s, p[3 * k + 1] + dx * s, p[3 * k + 2]]);
    right.push([p[3 * k] + dy * s, p[3 * k + 1] - dx * s, p[3 * k + 2]]);
  }
  return [...left, ...right.reverse()];
}
