// Puts the viewer together where the page has it.

class Viewer {
  constructor(root, payload) {
    this.root = root;
    this.alone = document.body.classList.contains('cmv-page');
    this.model = buildModel(payload);
    this.view = new View(this.model);
    this.state = {
      layers: layersOf(this.model), chosen: null, drive: null, detection: null, magnify: 1, shared: true, ratio: 1,
    };
    this.canvas = h('canvas', { tabindex: '0', role: 'application', 'aria-label': this.described(), 'aria-describedby': 'cmv-keys' });
    this.painter = new Painter(this.canvas, this.model, this.view, this.state);
    this.place = h('div', { class: 'cmv-place', 'aria-hidden': 'true' });
    this.scaleBar = h('div', { class: 'cmv-scale', 'aria-hidden': 'true' }, h('span', {}));
    this.north = h('div', { class: 'cmv-north', 'aria-hidden': 'true' }, h('b', {}, '\u25b2'), 'N');
    this.solid = h('button', { type: 'button', 'aria-pressed': 'false', onclick: () => this.tilt() }, '3D');
    this.build();
    this.listen();
    this.resize();
    this.home();
  }

  described() {
    const { head, signs, lanes, drives } = this.model;
    return `${head.title}: map with ${plural(signs.length, 'sign')}, ${plural(lanes.length, 'lane marker')} and ${plural(drives.length, 'drive')}; `
      + 'all of them are in the lists beside it';
  }

  build() {
    const { head } = this.model, title = this.alone ? 'h1' : 'h3';
    this.search = h('input', {
      type: 'search', placeholder: 'search: id, code, shape', 'aria-label': 'search the list by id, code or shape',
      oninput: (event) => this.panel.search(event.target.value),
      onkeydown: (event) => { if (event.key === 'Enter') this.chooseFound(); },
    });
    const button = (text, label, act) => h('button', { type: 'button', 'aria-label': label, title: label, onclick: () => { act(); this.redraw(); } }, text);
    const bar = h('div', { class: 'cmv-head' }, this.alone ? h(title, {}, head.title) : '', this.alone ? h('span', { class: 'cmv-soft' }, head.subtitle) : '', this.search);
    const tools = h('div', { class: 'cmv-tools' }, this.solid, button('+', 'nearer', () => this.view.zoom(1.5)),
      button('\u2212', 'further', () => this.view.zoom(1 / 1.5)), button('all', 'show everything', () => this.home()));
    this.panel = new Panel(this);
    const stage = h('div', { class: 'cmv-stage' }, this.canvas, tools, layerBox(this), this.north, this.place, this.scaleBar,
      h('p', { id: 'cmv-keys', class: 'cmv-hidden' }, 'Arrows move, with shift turn; plus and minus zoom; 3 tilts; n and p step through the list; slash searches; Escape lets go.'));
    this.root.replaceChildren(bar, h('div', { class: 'cmv-body' }, stage, this.panel.element));
  }

  listen() {
    listenTo(this.canvas, this);
    new ResizeObserver(() => this.resize()).observe(this.canvas.parentElement);
    const dark = window.matchMedia('(prefers-color-scheme: dark)');
    dark.addEventListener('change', () => this.recolor());
    this.painter.readTheme(this.root);
  }

  recolor() {
    this.painter.readTheme(this.root);
    this.redraw();
    if (this.panel.redrawPicture && this.state.chosen) this.panel.redrawPicture();
  }

  resize() {
    const stage = this.canvas.parentElement, { view, state } = this;
    const first = view.width === 100;
    state.ratio = Math.min(window.devicePixelRatio || 1, 2);
    [view.width, view.height] = [Math.max(stage.clientWidth, 50), Math.max(stage.clientHeight, 50)];
    this.canvas.width = view.width * state.ratio;
    this.canvas.height = view.height * state.ratio;
    view.update();
    if (first) this.home();
    this.now();
  }

  // Draws when the browser shows the next picture, once however often it is asked.
  redraw() {
    if (this.asked) return;
    this.asked = requestAnimationFrame(() => this.now());
  }

  now() {
    this.asked = 0;
    this.painter.draw();
    this.annotate();
  }

  later(act) { requestAnimationFrame(act); }

  annotate() {
    const { view } = this, power = 10 ** Math.floor(Math.log10(120 / view.scale));
    const length = [5, 2, 1].map((k) => k * power).find((l) => l * view.scale <= 120) || power;
    this.scaleBar.style.width = `${length * view.scale}px`;
    this.scaleBar.firstChild.textContent = length >= 1000 ? `${length / 1000} km` : `${Number(length.toPrecision(2))} m`;
    this.north.firstChild.style.transform = `rotate(${view.turn}rad)`;
  }

  hover(x, y) {
    if (this.hovering) return;
    this.hovering = requestAnimationFrame(() => {
      this.hovering = 0;
      const found = this.painter.pick(x, y, 14), ground = this.view.ground(x, y);
      this.canvas.style.cursor = found ? 'pointer' : 'grab';
      const where = ground ? `east ${number(ground[0], 1)} m, north ${number(ground[1], 1)} m` : '';
      this.place.textContent = found ? `${this.nameOf(found)} \u00b7 ${where}` : where;
    });
  }

  nameOf({ kind, row }) {
    const { signs, lanes, drives, frames } = this.model;
    if (kind === 'sign') return [signs[row].code, this.panel.shapes[signs[row].shape], signs[row].id].filter(Boolean).join(', ');
    if (kind === 'lane') return `${this.panel.types[lanes[row].type]} marker ${lanes[row].id}`;
    return kind === 'drive' ? drives[row].id : `${drives[frames[row].drive].id}, frame ${frames[row].number}`;
  }

  // Shows a thing, told of in the panel; `fly` brings it into sight, `follow` only where it left it.
  choose(chosen, { fly = false, follow = false } = {}) {
    const { state, model, view } = this;
    state.chosen = chosen;
    state.detection = null;
    state.drive = chosen && chosen.kind === 'drive' ? chosen.row : chosen && chosen.kind === 'frame' ? model.frames[chosen.row].drive : null;
    this.panel.redrawPicture = null;
    this.panel.tell(chosen);
    if (chosen && (fly || follow)) {
      const { kind, row } = chosen;
      if (kind === 'sign' || kind === 'frame') {
        const thing = kind === 'sign' ? model.signs[row] : model.frames[row], p = view.project(thing.x, thing.y, thing.z);
        const away = p[0] < 40 || p[1] < 40 || p[0] > view.width - 40 || p[1] > view.height - 40;
        if (fly || away) view.look(thing.x, thing.y, thing.z, fly ? Math.max(view.scale, 12) : 0);
      } else this.fit(kind === 'lane' ? model.lanes[row] : model.paths[row]);
    }
    this.redraw();
  }

  // A line as large as the canvas.
  fit(line) {
    const p = line.points, box = [Infinity, Infinity, -Infinity, -Infinity];
    for (let k = 0; k < p.length; k += 3) {
      box[0] = Math.min(box[0], p[k]); box[2] = Math.max(box[2], p[k]);
      box[1] = Math.min(box[1], p[k + 1]); box[3] = Math.max(box[3], p[k + 1]);
    }
    if (!p.length) return;
    const size = Math.max(box[2] - box[0], box[3] - box[1], 10);
    this.view.look((box[0] + box[2]) / 2, (box[1] + box[3]) / 2, p[2], 0.85 * Math.min(this.view.width, this.view.height) / size);
  }

  chooseFound() {
    const [first] = this.panel.found || [];
    if (first) this.choose({ kind: this.panel.kind.name, row: first.row }, { fly: true });
  }

  // The next of the list, or of a drive's frames.
  step(way) {
    const { chosen } = this.state;
    const frames = chosen && chosen.kind === 'frame' ? this.model.framesOf.get(this.model.frames[chosen.row].drive) : null;
    const rows = frames || this.panel.found || [], kind = frames ? 'frame' : this.panel.kind && this.panel.kind.name;
    if (!rows.length) return;
    const at = chosen && chosen.kind === kind ? rows.findIndex((row) => row.row === chosen.row) : way > 0 ? -1 : 0;
    this.choose({ kind, row: rows[(at + way + rows.length) % rows.length].row }, { fly: !frames, follow: true });
  }

  // The row of a sign by its id, as another part of the page asks for it.
  chooseSign(id) {
    const sign = this.model.signs.find((one) => one.id === id);
    if (sign) this.choose({ kind: 'sign', row: sign.row }, { fly: true });
    return Boolean(sign);
  }

  setLayer(name, on) {
    this.state.layers[name] = on;
    this.redraw();
  }

  setMagnify(factor) {
    this.state.magnify = factor;
    this.redraw();
  }

  home() {
    this.view.home();
    this.redraw();
  }

  tilt() {
    this.view.solid = !this.view.solid;
    this.solid.setAttribute('aria-pressed', String(this.view.solid));
    if (this.view.solid && this.state.chosen && this.state.chosen.kind === 'sign') this.faceSign(this.model.signs[this.state.chosen.row]);
    this.view.update();
    this.redraw();
  }

  // As its driver sees it.
  faceSign(sign) {
    const n = sign.axes[2];
    this.view.turn = Math.atan2(n[0], -n[1]);
    this.view.pitch = 0.25;
    this.view.look(sign.x, sign.y, sign.z, Math.max(this.view.scale, this.view.focal / 12));
  }
}

async function start() {
  const root = document.getElementById('crowdmap-viewer');
  try {
    const payload = await readPayload(document.getElementById('crowdmap-payload').textContent);
    root.viewer = new Viewer(root, payload);
    root.dataset.ready = Math.round(performance.now());
  } catch (error) {
    root.textContent = `The map could not be shown: ${error.message}. A browser of 2023 or later is needed.`;
    throw error;
  }
}

start();
