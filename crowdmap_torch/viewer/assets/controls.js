// Mouse, fingers and keys on the canvas; the layers.

const LAYERS = [ // name, what it is called, whether it is on at first, what of the model it needs, a colour of the theme
  ['signs', 'signs', true, (m) => m.signs.length, 'map'],
  ['names', 'codes', true, (m) => m.signs.length, ''],
  ['lanes', 'lane markers', true, (m) => m.lanes.length, 'marker'],
  ['ellipses', '95 % ellipses', true, (m) => m.signs.length || m.frames.length, 'map'],
  ['sigma', '95 % bands of markers', false, (m) => m.lanes.length, 'map'],
  ['drives', 'drives', true, (m) => m.paths.length, ''],
  ['frames', 'frames', true, (m) => m.frames.length, ''],
  ['given', 'drives as given', false, (m) => m.given.some((line) => line.count), ''],
  ['biases', 'biases of drives', false, (m) => m.drives.some((drive) => drive.bias), ''],
  ['rays', 'lines of sight', true, (m) => m.seen.size, ''],
  ['before', 'before adjustment', false, (m) => m.before.length || m.lanesBefore.length, 'before'],
  ['survey', 'survey', true, (m) => m.survey.length || m.surveyLanes.length, 'survey'],
  ['errors', 'errors of signs', true, (m) => m.has('sign.true'), 'bad'],
  ['grid', 'grid', true, () => true, 'grid'],
];

function layersOf(model) {
  return Object.fromEntries(LAYERS.map(([name, , on, needs]) => [name, on && Boolean(needs(model))]));
}

function layerBox(viewer) {
  const { model, state } = viewer;
  const rows = LAYERS.filter(([, , , needs]) => needs(model)).map(([name, title, , , color]) => h('label', {},
    h('input', { type: 'checkbox', checked: state.layers[name], 'data-layer': name, onchange: (event) => viewer.setLayer(name, event.target.checked) }),
    color ? h('i', { class: 'cmv-swatch', style: `background:var(--cmv-${color})` }) : '', title));
  const magnify = h('label', {}, 'ellipses, errors and biases ', h('select', {
    'aria-label': 'ellipses, errors and biases, times', onchange: (event) => viewer.setMagnify(Number(event.target.value)),
  }, [1, 10, 50].map((k) => h('option', { value: k }, `\u00d7 ${k}`))));
  const shared = model.head.shared_covariance ? h('label', {}, h('input', {
    type: 'checkbox', checked: true, onchange: (event) => { state.shared = event.target.checked; viewer.redraw(); },
  }), 'with what all drives share') : '';
  return h('details', { class: 'cmv-layers' }, h('summary', {}, 'Layers'), ...rows, magnify, shared);
}

function listenTo(canvas, viewer) {
  const { view } = viewer, fingers = new Map();
  let moved = 0, spread = null;
  const place = (event) => {
    const box = canvas.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  };
  canvas.addEventListener('pointerdown', (event) => {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, place(event));
    if (fingers.size === 1) moved = 0;
    spread = null;
  });
  canvas.addEventListener('pointermove', (event) => {
    const [x, y] = place(event);
    if (!fingers.has(event.pointerId)) {
      viewer.hover(x, y);
      return;
    }
    const [a, b] = fingers.get(event.pointerId), dx = x - a, dy = y - b;
    fingers.set(event.pointerId, [x, y]);
    moved += Math.abs(dx) + Math.abs(dy);
    if (fingers.size === 2) {
      const [p, q] = [...fingers.values()], wide = Math.hypot(p[0] - q[0], p[1] - q[1]) || 1;
      if (spread) view.zoom(wide / spread, (p[0] + q[0]) / 2, (p[1] + q[1]) / 2);
      spread = wide;
      view.pan(dx / 2, dy / 2);
    } else if (view.solid !== (event.shiftKey || event.buttons === 2)) view.orbit(dx, dy);
    else view.pan(dx, dy);
    viewer.redraw();
  });
  const release = (event) => {
    const was = fingers.delete(event.pointerId);
    spread = null;
    if (was && event.type === 'pointerup' && moved < 5 && !fingers.size) {
      const [x, y] = place(event);
      viewer.choose(viewer.painter.pick(x, y, event.pointerType === 'touch' ? 26 : 14));
    }
  };
  canvas.addEventListener('pointerup', release);
  canvas.addEventListener('pointercancel', release);
  canvas.addEventListener('contextmenu', (event) => event.preventDefault());
  canvas.addEventListener('wheel', (event) => {
    // Within another page the wheel moves that page, until the map was clicked.
    if (!viewer.alone && document.activeElement !== canvas) return;
    event.preventDefault();
    view.zoom(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0015)), ...place(event));
    viewer.redraw();
  }, { passive: false });
  canvas.addEventListener('keydown', (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const turn = event.shiftKey, step = 60;
    const move = (dx, dy) => (turn ? view.orbit(dx, dy) : view.pan(dx, dy));
    const keys = {
      ArrowLeft: () => move(step, 0), ArrowRight: () => move(-step, 0), ArrowUp: () => move(0, step), ArrowDown: () => move(0, -step),
      '+': () => view.zoom(1.4), '=': () => view.zoom(1.4), '-': () => view.zoom(1 / 1.4), 0: () => viewer.home(), Home: () => viewer.home(),
      3: () => viewer.tilt(), n: () => viewer.step(1), p: () => viewer.step(-1), '/': () => viewer.search.focus(), Escape: () => viewer.choose(null),
    };
    if (!keys[event.key]) return;
    event.preventDefault();
    keys[event.key]();
    viewer.redraw();
  });
}
