// What is drawn, made of the payload once: signs, lines cut into pieces with boxes around them, detections by sign.

const PIECE = 40; // points of a piece
const TOLERANCES = [0, 0.5, 4, 32]; // metres by which coarser pieces of a line may be off
const CHI95 = Math.sqrt(5.991); // radius of the 95 % ellipse of two numbers, in sigmas

function buildModel({ head, columns }) {
  const column = (name) => (columns[name] ? columns[name].values : new Float64Array(0));
  const has = (name) => Boolean(columns[name] && columns[name].rows);
  const model = { head, kind: head.kind, has };
  model.signs = readPlates(head, column, 'sign', head.sign_id || []);
  model.signs.forEach((sign, k) => {
    sign.journeys = column('sign.journeys')[k];
    sign.observations = column('sign.observations')[k];
    sign.first = column('sign.first_s')[k];
    sign.last = column('sign.last_s')[k];
    sign.confidence = column('sign.confidence')[k];
    if (has('sign.true')) {
      sign.true = column('sign.true')[k];
      sign.error = column('sign.error').subarray(3 * k, 3 * k + 3);
      sign.errorM = column('sign.error_m')[k];
    }
  });
  model.before = readPlates(head, column, 'before.sign', head.before_id || []);
  const own = new Map(model.before.map((sign) => [sign.id, sign]));
  model.signs.forEach((sign) => { sign.before = own.get(sign.id); });
  model.survey = readSurvey(head, column);
  for (const sign of model.signs) if (sign.true >= 0) model.survey[sign.true].found = true;
  const types = (name) => Array.from(column(name));
  model.lanes = readLines(column, 'lane', types('lane.type'), head.lane_id);
  model.lanes.forEach((lane, k) => {
    lane.sigma = column('lane.sigma').subarray(lane.first, lane.first + lane.count);
    for (const name of ['journeys', 'observations', 'first_s', 'last_s', 'confidence']) {
      lane[name] = column('lane.' + name)[k];
    }
  });
  model.lanesBefore = readLines(column, 'before.lane', types('before.lane.type'));
  model.surveyLanes = readLines(column, 'survey.lane', types('survey.lane.type'));
  model.drives = head.drives;
  model.paths = readLines(column, 'path');
  model.given = readLines(column, 'given');
  readSeen(model, head, column);
  readFrames(model, column);
  putOnGround(model);
  model.bounds = boundsOf(model);
  return model;
}

function readPlates(head, column, prefix, ids) {
  const shared = head.shared_covariance || new Array(9).fill(0);
  return ids.map((id, k) => {
    const at = (name, width) => column(prefix + '.' + name).subarray(width * k, width * k + width);
    const [x, y, z] = at('center', 3), [w, h] = at('size', 2), c = Array.from(at('covariance', 6));
    const axes = axesOf(at('quaternion', 4)), shape = column(prefix + '.shape')[k];
    const type = column(prefix + '.type')[k];
    const corners = [];
    const template = head.templates[shape];
    for (let j = 0; j < template.length; j += 2) {
      const a = template[j] * w, b = template[j + 1] * h;
      corners.push([0, 1, 2].map((i) => [x, y, z][i] + a * axes[0][i] + b * axes[1][i]));
    }
    const own = [c[0] - shared[0], c[1] - shared[1], c[3] - shared[4]];
    return {
      row: k, id, shape, x, y, z, w, h, axes, corners, covariance: c,
      code: type >= 0 ? head.type_names[type] : '',
      ellipse: ellipseOf(c[0], c[1], c[3]), ownEllipse: ellipseOf(...own),
    };
  });
}

// Columns of the rotation of a unit quaternion: right, up and towards the driver.
function axesOf(q) {
  const n = Math.hypot(...q) || 1, [x, y, z, w] = Array.from(q, (v) => v / n);
  return [
    [1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)],
    [2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w)],
    [2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)],
  ];
}

// Half axes of the 95 % ellipse and the angle of the longer one, from east to north.
function ellipseOf(xx, xy, yy) {
  const middle = (xx + yy) / 2, away = Math.hypot((xx - yy) / 2, xy);
  return {
    a: CHI95 * Math.sqrt(Math.max(middle + away, 0)),
    b: CHI95 * Math.sqrt(Math.max(middle - away, 0)),
    angle: Math.atan2(2 * xy, xx - yy) / 2,
  };
}

function readSurvey(head, column) {
  return (head.survey_id || []).map((id, k) => {
    const [x, y, z] = column('survey.center').subarray(3 * k, 3 * k + 3);
    const shape = column('survey.shape')[k], away = column('survey.corner').subarray(24 * k, 24 * k + 24);
    const corners = [];
    if (away.some((v) => v !== 0)) {
      for (let j = 0; j < head.templates[shape].length / 2; j++) {
        corners.push([x + away[3 * j], y + away[3 * j + 1], z + away[3 * j + 2]]);
      }
    }
    return { row: k, id, shape, x, y, z, corners };
  });
}

function readLines(column, name, types, ids) {
  const count = column(name + '.count'), points = column(name + '.point');
  const lines = [];
  let first = 0;
  for (let k = 0; k < count.length; k++) {
    const own = points.subarray(3 * first, 3 * (first + count[k]));
    lines.push({
      row: k, id: ids ? ids[k] : '', type: types ? types[k] : -1, first, count: count[k],
      points: own, pieces: piecesOf(own),
    });
    first += count[k];
  }
  return lines;
}

// Pieces of a line, each with its box and, for every tolerance, the points that are kept.
function piecesOf(points) {
  const last = points.length / 3 - 1, pieces = [];
  for (let a = 0; a < last; a += PIECE) {
    const b = Math.min(a + PIECE, last), box = [Infinity, Infinity, -Infinity, -Infinity, Infinity, -Infinity];
    for (let k = a; k <= b; k++) {
      const x = points[3 * k], y = points[3 * k + 1], z = points[3 * k + 2];
      if (x < box[0]) box[0] = x;
      if (y < box[1]) box[1] = y;
      if (x > box[2]) box[2] = x;
      if (y > box[3]) box[3] = y;
      if (z < box[4]) box[4] = z;
      if (z > box[5]) box[5] = z;
    }
    pieces.push({ a, b, box, levels: TOLERANCES.map((t) => thinned(points, a, b, t)) });
  }
  return pieces;
}

function thinned(points, a, b, tolerance) {
  const kept = [a];
  for (let k = a + 1; k < b; k++) {
    const l = kept[kept.length - 1];
    const way = Math.hypot(points[3 * k] - points[3 * l], points[3 * k + 1] - points[3 * l + 1]);
    if (way > tolerance || tolerance === 0) kept.push(k);
  }
  kept.push(b);
  return Int32Array.from(kept);
}

// Of a run: detections of every sign, and of each of its drives what it saw of it.
function readSeen(model, head, column) {
  const pairs = [], seen = [];
  const pairSign = column('pair.sign');
  for (let k = 0; k < pairSign.length; k++) {
    pairs.push({
      sign: pairSign[k], drive: column('pair.drive')[k], rms: column('pair.rms')[k],
      used: column('pair.used')[k], givenUp: column('pair.given_up')[k], near: column('pair.near')[k],
    });
  }
  const of = column('seen.pair');
  for (let k = 0; k < of.length; k++) {
    const shape = column('seen.shape')[k], n = head.templates[shape].length / 2;
    const take = (name, width) => column(name).subarray(width * k, width * k + width);
    seen.push({
      pair: of[k], sign: pairs[of[k]].sign, drive: pairs[of[k]].drive,
      frame: column('seen.frame')[k], state: column('seen.state')[k],
      fate: head.fates[column('seen.fate')[k]], shape, corners: n,
      px: take('seen.corner', 16), residual: column('seen.has')[k] ? take('seen.residual', 16) : null,
      from: take('seen.from', 3),
    });
  }
  model.pairs = groupBy(pairs, (pair) => pair.sign);
  model.seen = groupBy(seen, (one) => one.sign);
}

function groupBy(rows, key) {
  const groups = new Map();
  for (const row of rows) {
    if (!groups.has(key(row))) groups.set(key(row), []);
    groups.get(key(row)).push(row);
  }
  return groups;
}

// Of a data set: frames, each with where its detections begin.
function readFrames(model, column) {
  const number = column('frame.number');
  model.frames = [];
  let sign = 0, lane = 0, point = 0;
  for (let k = 0; k < number.length; k++) {
    const take = (name, width) => column(name).subarray(width * k, width * k + width);
    const [x, y, z] = take('frame.place', 3), frame = {
      row: k, drive: column('frame.drive')[k], number: number[k], ms: column('frame.ms')[k],
      x, y, z, axes: axesOf(take('frame.quaternion', 4)), sigma: take('frame.sigma', 3), signs: [], lanes: [],
    };
    for (let j = 0; j < column('frame.signs')[k]; j++, sign++) {
      const type = column('frame.sign_type')[sign], shape = column('frame.sign_shape')[sign];
      frame.signs.push({
        shape, corners: model.head.templates[shape].length / 2, code: type >= 0 ? model.head.type_names[type] : '',
        px: column('frame.sign_corner').subarray(16 * sign, 16 * sign + 16),
      });
    }
    for (let j = 0; j < column('frame.lanes')[k]; j++, lane++) {
      const count = column('frame.lane_count')[lane];
      frame.lanes.push({
        type: column('frame.lane_type')[lane],
        px: column('frame.lane_point').subarray(2 * point, 2 * (point + count)),
      });
      point += count;
    }
    model.frames.push(frame);
  }
  model.framesOf = groupBy(model.frames, (frame) => frame.drive);
}

// The ground under every sign: the height of the nearest point of a marker, or of a drive less a car's height.
function putOnGround(model) {
  const cell = 8, grid = new Map();
  const add = (lines, lower) => {
    for (const { points } of lines) {
      for (let k = 0; k < points.length; k += 3) {
        const steps = k + 3 < points.length
          ? Math.ceil(Math.hypot(points[k + 3] - points[k], points[k + 4] - points[k + 1]) / cell) : 1;
        for (let j = 0; j < steps; j++) {
          const s = j / steps, to = steps > 1 ? k + 3 : k;
          const x = points[k] + s * (points[to] - points[k]), y = points[k + 1] + s * (points[to + 1] - points[k + 1]);
          const key = Math.floor(x / cell) + ',' + Math.floor(y / cell);
          if (!grid.has(key)) grid.set(key, points[k + 2] + s * (points[to + 2] - points[k + 2]) - lower);
        }
      }
    }
  };
  add(model.lanes, 0);
  if (!model.lanes.length) add(model.surveyLanes, 0);
  if (!grid.size) add(model.paths, 1.5);
  const below = (sign) => {
    const i = Math.floor(sign.x / cell), j = Math.floor(sign.y / cell);
    for (let ring = 0; ring < 3; ring++) {
      for (let a = -ring; a <= ring; a++) {
        for (let b = -ring; b <= ring; b++) {
          const z = grid.get((i + a) + ',' + (j + b));
          if (z !== undefined) return Math.min(z, sign.z - sign.h);
        }
      }
    }
    return sign.z - 2.2;
  };
  for (const sign of [...model.signs, ...model.before, ...model.survey]) sign.ground = below({ h: 0.6, ...sign });
}

function boundsOf(model) {
  const box = [Infinity, Infinity, -Infinity, -Infinity];
  let z = 0, n = 0;
  const add = (x, y, height) => {
    box[0] = Math.min(box[0], x); box[1] = Math.min(box[1], y);
    box[2] = Math.max(box[2], x); box[3] = Math.max(box[3], y);
    z += height; n++;
  };
  const ofMap = model.signs.length + model.lanes.length;
  for (const sign of ofMap ? model.signs : model.survey) add(sign.x, sign.y, sign.ground);
  for (const line of ofMap ? model.lanes : [...model.paths, ...model.surveyLanes]) {
    for (let k = 0; k < line.points.length; k += 3) add(line.points[k], line.points[k + 1], line.points[k + 2]);
  }
  if (!n) add(0, 0, 0);
  return { box, z: z / n };
}
