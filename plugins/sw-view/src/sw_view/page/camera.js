// The eye of the page: where it is, what it turns around, and how pointers, wheel and keys move it.
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const plus = (a, b, s = 1) => a.map((v, i) => v + s * b[i]);
const unit = a => a.map(v => v / (Math.hypot(...a) || 1));

function turned(v, axis, angle) {  // Rodrigues; axis of unit length
  const c = Math.cos(angle), s = Math.sin(angle), d = dot(axis, v) * (1 - c);
  const across = [axis[1] * v[2] - axis[2] * v[1], axis[2] * v[0] - axis[0] * v[2], axis[0] * v[1] - axis[1] * v[0]];
  return v.map((value, i) => value * c + across[i] * s + axis[i] * d);
}

class Eye {
  constructor(facts, changed) {
    this.up = facts.up, this.pivot = facts.pivot, this.size = facts.size, this.changed = changed;
    this.orbits = true;
    this.show(facts.cameras[0]);
  }

  show(camera) {  // a camera of the list: {width, height, fx, fy, cx, cy, R, tau}
    this.camera = camera;
    this.axes = [0, 3, 6].map(i => camera.R.slice(i, i + 3));  // right, down, forward
    this.eye = [0, 1, 2].map(k => -this.axes.reduce((sum, axis, i) => sum + axis[k] * camera.tau[i], 0));
    this.zoom = 1;
    this.changed();
  }

  get place() {
    const { camera, axes, eye, pivot, zoom } = this;
    return { camera, axes, eye, pivot, zoom };
  }

  take(place) {  // of another page's eye
    Object.assign(this, place);
    this.changed();
  }

  get pose() {
    return { R: this.axes.flat(), tau: this.axes.map(axis => -dot(axis, this.eye)), eye: this.eye };
  }

  // The camera's whole picture fits into the canvas, centred.
  lens(width, height) {
    const { camera } = this, fit = Math.min(width / camera.width, height / camera.height), scale = fit * this.zoom;
    return {
      fx: camera.fx * scale, fy: camera.fy * scale,
      cx: width / 2 + (camera.cx - camera.width / 2) * scale, cy: height / 2 + (camera.cy - camera.height / 2) * scale,
    };
  }

  get distance() { return Math.max(1e-3 * this.size, Math.hypot(...plus(this.pivot, this.eye, -1))); }

  turn(x, y) {  // radians by which the scene follows to the right and down: around the pivot, or seen from the spot
    const sign = this.orbits ? -1 : 1, slope = angle => dot(turned(this.axes[2], this.axes[0], angle), this.up);
    // Stops short of the poles, where right and left would lose their meaning.
    const turnable = Math.abs(slope(sign * y)) < Math.max(0.995, Math.abs(slope(0)));
    for (const [axis, angle] of [[this.up, sign * x], [this.axes[0], turnable ? sign * y : 0]]) {
      if (this.orbits) this.eye = plus(this.pivot, turned(plus(this.eye, this.pivot, -1), axis, angle));
      this.axes = this.axes.map(each => turned(each, axis, angle));
    }
    this.axes[2] = unit(this.axes[2]);
    this.axes[0] = unit(plus(this.axes[0], this.axes[2], -dot(this.axes[0], this.axes[2])));
    const [r, , f] = this.axes;
    this.axes[1] = [f[1] * r[2] - f[2] * r[1], f[2] * r[0] - f[0] * r[2], f[0] * r[1] - f[1] * r[0]];
    this.changed();
  }

  move(right, down, forward) {  // in units of the distance to the pivot; the pivot comes along sideways
    const d = this.distance;
    const shift = plus(this.axes[0].map(v => v * right * d), this.axes[1], down * d);
    this.eye = plus(this.eye, shift), this.pivot = plus(this.pivot, shift);
    if (this.orbits) this.eye = plus(this.pivot, plus(this.eye, this.pivot, -1), Math.exp(-forward));
    else this.eye = plus(this.eye, this.axes[2], forward * 0.5 * this.size);
    this.changed();
  }
}

const KEYS = {
  w: [0, 0, 1], s: [0, 0, -1], a: [-1, 0, 0], d: [1, 0, 0], q: [0, -1, 0], e: [0, 1, 0], '+': [0, 0, 1], '-': [0, 0, -1],
};
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

function listen(canvas, eye, commands) {
  const pointers = new Map();
  canvas.addEventListener('pointerdown', event => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, [event.clientX, event.clientY]);
  });
  for (const kind of ['pointerup', 'pointercancel']) {
    canvas.addEventListener(kind, event => pointers.delete(event.pointerId));
  }
  canvas.addEventListener('pointermove', event => {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const now = [event.clientX, event.clientY], size = Math.min(canvas.clientWidth, canvas.clientHeight);
    const x = (now[0] - before[0]) / size, y = (now[1] - before[1]) / size;
    if (pointers.size === 2) {
      const [other] = [...pointers].filter(([id]) => id !== event.pointerId).map(([, place]) => place);
      const apart = place => Math.hypot(place[0] - other[0], place[1] - other[1]) || 1;
      eye.move(-x / 2, -y / 2, Math.log(apart(now) / apart(before)));
    } else if (event.shiftKey || event.buttons & 6) eye.move(-x, -y, 0);
    else eye.turn(x * Math.PI, y * Math.PI);
    pointers.set(event.pointerId, now);
  });
  canvas.addEventListener('contextmenu', event => event.preventDefault());
  canvas.addEventListener('wheel', event => {
    event.preventDefault();
    const lines = event.deltaMode === 1 ? 16 : 1;
    eye.move(0, 0, Math.max(-0.5, Math.min(0.5, -event.deltaY * lines / 600)));
  }, { passive: false });
  addEventListener('keydown', event => {
    if (event.ctrlKey || event.metaKey || event.altKey || /SELECT|INPUT/.test(event.target.tagName)) return;
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    if (key in ARROWS) eye.turn(...ARROWS[key].map(v => v * (eye.orbits ? 0.05 : -0.05)));
    else if (key in KEYS) eye.move(...KEYS[key].map(v => v * 0.06));
    else if (key in commands) commands[key]();
    else return;
    event.preventDefault();
  });
}
