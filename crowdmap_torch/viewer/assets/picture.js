// Detections in image coordinates: all of a sign, one of them enlarged with its residuals, or everything of a frame.

const KINDS = ['counted', 'given up', 'only lies on it'];

class Picture {
  constructor(canvas, painter) {
    this.canvas = canvas;
    this.ctx = canvas.getContext('2d');
    this.painter = painter;
  }

  // A canvas as wide as it is shown, with a frame of pixels in it; a function from pixels to it.
  begin(box) {
    const ratio = this.painter.state.ratio, wide = this.canvas.clientWidth || 320;
    const high = Math.round(Math.min(wide * box.h / box.w, 420));
    this.canvas.style.height = high + 'px';
    this.canvas.width = wide * ratio;
    this.canvas.height = high * ratio;
    const k = Math.min(wide / box.w, high / box.h), { ctx } = this, { theme } = this.painter;
    ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
    ctx.fillStyle = theme.back;
    ctx.fillRect(0, 0, wide, high);
    const left = (wide - k * box.w) / 2;
    this.k = k;
    return (u, v) => [left + (u - box.x) * k, (v - box.y) * k];
  }

  outline(at, px, corners, color, width, { dash = [], alpha = 1, shift = null } = {}) {
    const { ctx } = this;
    ctx.beginPath();
    for (let k = 0; k < corners; k++) {
      const p = at(px[2 * k] + (shift ? shift[2 * k] : 0), px[2 * k + 1] + (shift ? shift[2 * k + 1] : 0));
      if (k) ctx.lineTo(...p);
      else ctx.moveTo(...p);
    }
    ctx.closePath();
    ctx.strokeStyle = color;
    ctx.lineWidth = width;
    ctx.globalAlpha = alpha;
    ctx.setLineDash(dash);
    ctx.stroke();
    ctx.setLineDash([]);
    ctx.globalAlpha = 1;
  }

  frameOf(drive, all) {
    const image = this.painter.model.drives[drive] && this.painter.model.drives[drive].image;
    if (image) return { x: -0.5, y: -0.5, w: image[0], h: image[1] };
    let w = 640, h = 400;
    for (const px of all) {
      for (let k = 0; k < 16; k += 2) [w, h] = [Math.max(w, px[k] * 1.05), Math.max(h, px[k + 1] * 1.05)];
    }
    return { x: 0, y: 0, w, h };
  }

  border(at, box) {
    const a = at(box.x, box.y), b = at(box.x + box.w, box.y + box.h);
    this.ctx.strokeStyle = this.painter.theme.line;
    this.ctx.strokeRect(a[0] + 0.5, a[1] + 0.5, b[0] - a[0] - 1, b[1] - a[1] - 1);
  }

  // All detections of a sign; the larger, the nearer the car was.
  all(seen, chosen) {
    const { theme } = this.painter, box = this.frameOf(seen[0].drive, seen.map((one) => one.px));
    const at = this.begin(box);
    this.border(at, box);
    for (const one of seen) {
      const color = one.state ? theme.bad : driveColor(one.drive);
      this.outline(at, one.px, one.corners, color, one === chosen ? 3 : 1, {
        alpha: one === chosen ? 1 : 0.55, dash: one.state === 2 ? [3, 3] : [],
      });
    }
  }

  // One detection: as detected, as the map projects, and residuals, magnified.
  one(seen, magnify) {
    const { theme } = this.painter, { ctx } = this;
    let [x0, y0, x1, y1] = [Infinity, Infinity, -Infinity, -Infinity];
    for (let k = 0; k < seen.corners; k++) {
      [x0, x1] = [Math.min(x0, seen.px[2 * k]), Math.max(x1, seen.px[2 * k])];
      [y0, y1] = [Math.min(y0, seen.px[2 * k + 1]), Math.max(y1, seen.px[2 * k + 1])];
    }
    const side = 1.6 * Math.max(x1 - x0, y1 - y0, 6);
    const box = { x: (x0 + x1) / 2 - side * 0.75, y: (y0 + y1) / 2 - side / 2, w: 1.5 * side, h: side };
    const at = this.begin(box);
    this.border(at, box);
    this.outline(at, seen.px, seen.corners, seen.state ? theme.bad : driveColor(seen.drive), 2.5);
    if (!seen.residual) return;
    this.outline(at, seen.px, seen.corners, theme.map, 1.5, { shift: seen.residual, dash: [5, 4] });
    ctx.strokeStyle = theme.ink;
    ctx.lineWidth = 1.5;
    for (let k = 0; k < seen.corners; k++) {
      const [u, v] = [seen.px[2 * k], seen.px[2 * k + 1]], r = [seen.residual[2 * k], seen.residual[2 * k + 1]];
      ctx.beginPath();
      ctx.moveTo(...at(u, v));
      ctx.lineTo(...at(u + magnify * r[0], v + magnify * r[1]));
      ctx.stroke();
    }
  }

  // Everything that was detected in a frame.
  frame(frame) {
    const { theme, model } = this.painter, { ctx } = this;
    const box = this.frameOf(frame.drive, frame.signs.map((sign) => sign.px));
    const at = this.begin(box);
    this.border(at, box);
    const colors = { '-1': theme.soft, 0: theme.marker, 1: theme.marker, 2: theme.marker, 3: theme.curb };
    for (const lane of frame.lanes) {
      ctx.beginPath();
      for (let k = 0; k < lane.px.length; k += 2) {
        const p = at(lane.px[k], lane.px[k + 1]);
        if (k) ctx.lineTo(...p);
        else ctx.moveTo(...p);
      }
      ctx.strokeStyle = colors[lane.type];
      ctx.lineWidth = lane.type === 2 ? 4 : 2;
      ctx.setLineDash(lane.type === 1 ? [7, 5] : []);
      ctx.stroke();
    }
    ctx.setLineDash([]);
    ctx.font = '11px system-ui, sans-serif';
    for (const sign of frame.signs) {
      const [face, rim] = PLATES[model.head.shapes[sign.shape]];
      this.outline(at, sign.px, sign.corners, rim === '#ffffff' ? face : rim, 2);
      if (!sign.code) continue;
      ctx.fillStyle = theme.ink;
      const p = at(sign.px[0], sign.px[1]);
      ctx.fillText(sign.code, p[0], p[1] - 5);
    }
  }
}
