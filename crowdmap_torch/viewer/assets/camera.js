// From metres to pixels of the canvas: from above, or in perspective around a point on the ground.

const NEAR = 0.4; // metres before the eye where lines are cut off
const MARGIN = 8; // pixels around the canvas that lines may reach into it from
const SHORTEST = 1.5, LONGEST = 200000; // from the eye to what it looks at

class View {
  constructor(model) {
    this.model = model;
    this.width = this.height = 100;
    this.x = this.y = this.z = 0;
    this.scale = 1;   // pixels a metre, where the view looks
    this.turn = 0;    // of the way to the right, from east to north
    this.pitch = 0.6; // of the view below the horizon, in 3D
    this.solid = false;
    this.update();
  }

  get focal() { return 0.9 * Math.max(this.width, this.height); }

  // Numbers that every point is multiplied by.
  update() {
    const c = Math.cos(this.turn), s = Math.sin(this.turn), k = this.scale;
    this.right = [c, s, 0];
    const ahead = [-s, c];
    if (!this.solid) {
      this.m = [k * c, k * s, -k * ahead[0], -k * ahead[1]];
      this.m.push(this.width / 2 - this.m[0] * this.x - this.m[1] * this.y);
      this.m.push(this.height / 2 - this.m[2] * this.x - this.m[3] * this.y);
      this.box = this.reach();
      return;
    }
    const cp = Math.cos(this.pitch), sp = Math.sin(this.pitch);
    this.forward = [cp * ahead[0], cp * ahead[1], -sp];
    this.up = [sp * ahead[0], sp * ahead[1], cp];
    this.distance = this.focal / k;
    this.far = Math.max(12 * this.distance, 400);
    const at = [this.x, this.y, this.z];
    this.eye = at.map((v, i) => v - this.distance * this.forward[i]);
    // Inward normals of the four sides of what is seen, and of the near side.
    const w = this.width / 2 + MARGIN, h = this.height / 2 + MARGIN, f = this.focal, n = this.forward;
    const side = (axis, sign, half) => axis.map((v, i) => sign * f * v + half * n[i]);
    this.sides = [side(this.right, 1, w), side(this.right, -1, w), side(this.up, 1, h), side(this.up, -1, h), n];
  }

  // Whether a box (east and north from, to; up from, to) may be in sight.
  sees(b) {
    if (!this.solid) {
      const r = this.box;
      return b[2] >= r[0] && b[0] <= r[2] && b[3] >= r[1] && b[1] <= r[3];
    }
    const [x, y, z] = this.eye;
    const dx = Math.max(b[0] - x, x - b[2], 0), dy = Math.max(b[1] - y, y - b[3], 0);
    if (dx * dx + dy * dy > this.far * this.far) return false;
    for (const n of this.sides) {
      const a = (n[0] > 0 ? b[2] : b[0]) - x, c = (n[1] > 0 ? b[3] : b[1]) - y, d = (n[2] > 0 ? b[5] : b[4]) - z;
      if (n[0] * a + n[1] * c + n[2] * d < 0) return false;
    }
    return true;
  }

  // [x, y, depth]; nothing that is nearer than NEAR can be drawn. From above the depth is one.
  project(x, y, z) {
    if (!this.solid) {
      const m = this.m;
      return [m[0] * x + m[1] * y + m[4], m[2] * x + m[3] * y + m[5], 1];
    }
    const p = this.inEye(x, y, z);
    return this.onScreen(p);
  }

  inEye(x, y, z) {
    const a = x - this.eye[0], b = y - this.eye[1], c = z - this.eye[2];
    const r = this.right, u = this.up, f = this.forward;
    return [r[0] * a + r[1] * b, u[0] * a + u[1] * b + u[2] * c, f[0] * a + f[1] * b + f[2] * c];
  }

  onScreen(p) {
    const d = Math.max(p[2], 1e-6), k = this.focal / d;
    return [this.width / 2 + k * p[0], this.height / 2 - k * p[1], p[2]];
  }

  // The point of the ground under a pixel, or null above the horizon.
  ground(px, py) {
    const a = px - this.width / 2, b = this.height / 2 - py;
    if (!this.solid) {
      const c = Math.cos(this.turn), s = Math.sin(this.turn);
      return [this.x + (c * a - s * b) / this.scale, this.y + (s * a + c * b) / this.scale];
    }
    const ray = [0, 1, 2].map((i) => this.right[i] * a + this.up[i] * b + this.forward[i] * this.focal);
    if (ray[2] >= -1e-3 * this.focal) return null;
    const t = (this.z - this.eye[2]) / ray[2];
    return [this.eye[0] + t * ray[0], this.eye[1] + t * ray[1]];
  }

  // What of the ground can be seen: a box, as far as it is worth drawing.
  reach() {
    if (this.solid) {
      const { eye, far } = this;
      return [eye[0] - far, eye[1] - far, eye[0] + far, eye[1] + far];
    }
    const a = this.ground(0, 0), b = this.ground(this.width, 0);
    const c = this.ground(0, this.height), d = this.ground(this.width, this.height);
    const x = [a[0], b[0], c[0], d[0]], y = [a[1], b[1], c[1], d[1]];
    return [Math.min(...x), Math.min(...y), Math.max(...x), Math.max(...y)];
  }

  pan(dx, dy) {
    const c = Math.cos(this.turn), s = Math.sin(this.turn);
    const up = this.solid ? dy / Math.max(Math.sin(this.pitch), 0.2) : dy;
    this.x -= (c * dx + s * up) / this.scale;
    this.y -= (s * dx - c * up) / this.scale;
    this.update();
  }

  zoom(factor, px = this.width / 2, py = this.height / 2) {
    const before = this.ground(px, py);
    const least = this.focal / LONGEST, most = this.focal / SHORTEST;
    this.scale = Math.min(Math.max(this.scale * factor, least), most);
    this.update();
    const after = before && this.ground(px, py);
    if (!after) return;
    this.x += before[0] - after[0];
    this.y += before[1] - after[1];
    this.update();
  }

  orbit(dx, dy) {
    this.turn -= dx * 0.006;
    if (this.solid) this.pitch = Math.min(Math.max(this.pitch + dy * 0.005, 0.03), Math.PI / 2);
    this.update();
  }

  // Everything, a long map laid along the longer side of the canvas.
  home() {
    const { box, z } = this.model.bounds;
    const w = Math.max(box[2] - box[0], 20), h = Math.max(box[3] - box[1], 20);
    this.x = (box[0] + box[2]) / 2;
    this.y = (box[1] + box[3]) / 2;
    this.z = z;
    const level = Math.min(this.width / w, this.height / h), aside = Math.min(this.width / h, this.height / w);
    this.turn = aside > 1.33 * level ? Math.PI / 2 : 0;
    this.scale = 0.9 * Math.max(level, aside > 1.33 * level ? aside : 0);
    this.update();
  }

  look(x, y, z, scale) {
    this.x = x;
    this.y = y;
    this.z = z;
    if (scale) this.scale = scale;
    this.update();
  }
}
