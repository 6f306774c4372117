// Mouse, fingers and keys on the view.

const CLICK_PX = 4;

function Input(view, actions) {
  this.view = view;
  this.actions = actions;
  this.pointers = new Map();
  this.keys = new Set();
  const canvas = view.canvas;
  const on = function (name, f) { canvas.addEventListener(name, f.bind(this)); }.bind(this);
  on("pointerdown", this.down);
  on("pointermove", this.move);
  on("pointerup", this.up);
  on("pointercancel", this.up);
  on("pointerleave", function () { if (this.pointers.size === 0) this.actions.hover(null); });
  on("dblclick", this.doubleClick);
  on("keydown", this.keyDown);
  on("keyup", function (e) { this.keys.delete(e.key.toLowerCase()); });
  on("blur", function () { this.keys.clear(); });
  on("contextmenu", function (e) { e.preventDefault(); });
  canvas.addEventListener("wheel", this.wheel.bind(this), { passive: false });
}

// Place on the canvas, the pane there, and the place in the pane.
Input.prototype.place = function (e) {
  const box = this.view.canvas.getBoundingClientRect();
  const x = e.clientX - box.left;
  const y = e.clientY - box.top;
  const pane = this.view.paneAt(x, y);
  this.view.refreshLens(pane);
  return { pane: pane, x: x - pane.rect.x, y: y - pane.rect.y, canvasX: x, canvasY: y };
};

Input.prototype.down = function (e) {
  const place = this.place(e);
  this.view.canvas.focus({ preventScroll: true });
  this.view.canvas.setPointerCapture(e.pointerId);
  this.view.cursor = { pane: place.pane, x: place.x, y: place.y, isKeyboard: false };
  this.pointers.set(e.pointerId, { x: e.clientX, y: e.clientY, startX: e.clientX, startY: e.clientY, isDrag: false, button: e.button, pane: place.pane });
  this.actions.hover(null);
};

Input.prototype.move = function (e) {
  const pointer = this.pointers.get(e.pointerId);
  if (!pointer) {
    if (e.pointerType === "mouse") this.actions.hover(this.place(e));
    return;
  }
  const dx = e.clientX - pointer.x;
  const dy = e.clientY - pointer.y;
  if (!pointer.isDrag && Math.hypot(e.clientX - pointer.startX, e.clientY - pointer.startY) < CLICK_PX) return;
  pointer.isDrag = true;
  const camera = pointer.pane.camera;
  const height = pointer.pane.rect.height;
  this.view.isMoving = true;
  if (this.pointers.size === 2) {
    this.pinch(e, pointer, camera, height);
  } else if (pointer.button === 2 || pointer.button === 1 || e.shiftKey) {
    camera.shift(dx, dy, height);
  } else {
    camera.turn(dx, dy, height);
  }
  pointer.x = e.clientX;
  pointer.y = e.clientY;
  this.actions.moved(camera);
};

// Two fingers: their distance zooms, their middle moves.
Input.prototype.pinch = function (e, pointer, camera, height) {
  const other = Array.from(this.pointers.entries()).find(function (p) { return p[0] !== e.pointerId; })[1];
  const before = Math.hypot(pointer.x - other.x, pointer.y - other.y);
  const after = Math.hypot(e.clientX - other.x, e.clientY - other.y);
  if (before > 0 && after > 0) camera.zoom(Math.log(after / before) / 0.15);
  camera.shift((e.clientX - pointer.x) / 2, (e.clientY - pointer.y) / 2, height);
};

Input.prototype.up = function (e) {
  const pointer = this.pointers.get(e.pointerId);
  this.pointers.delete(e.pointerId);
  this.view.isMoving = this.pointers.size > 0;
  this.view.request();
  if (!pointer || pointer.isDrag || e.type !== "pointerup" || pointer.button !== 0) return;
  this.actions.click(this.place(e), e.shiftKey);
};

Input.prototype.doubleClick = function (e) {
  if (this.view.measurement.isOn) return;
  const place = this.place(e);
  const hit = this.view.hit(place.pane, place.pane.lens, place.x, place.y);
  if (!hit) return;
  place.pane.camera.turnAbout(hit.point);
  this.actions.moved(place.pane.camera);
};

// The page scrolls until the view has been clicked: a reader who scrolls past must not be caught.
Input.prototype.wheel = function (e) {
  if (document.activeElement !== this.view.canvas && !e.ctrlKey) {
    this.actions.hint();
    return;
  }
  e.preventDefault();
  const unit = e.deltaMode === 1 ? 3 : 100;
  const camera = this.place(e).pane.camera;
  camera.zoom(clamped(-e.deltaY / unit, -4, 4));
  this.actions.moved(camera);
};

const TURNS = { arrowleft: [-1, 0], arrowright: [1, 0], arrowup: [0, -1], arrowdown: [0, 1] };
// To the right, ahead, up.
const STEPS = { w: [0, 1, 0], s: [0, -1, 0], a: [-1, 0, 0], d: [1, 0, 0], q: [0, 0, -1], e: [0, 0, 1] };
const ZOOMS = { "+": 1, "=": 1, "-": -1, pageup: 1, pagedown: -1 };

Input.prototype.keyDown = function (e) {
  if (e.altKey || e.ctrlKey || e.metaKey) return;
  const key = e.key.toLowerCase();
  const pane = this.view.cursor.pane.isShown ? this.view.cursor.pane : this.view.shownPanes()[0];
  this.view.cursor = { pane: pane, x: 0, y: 0, isKeyboard: true };
  this.view.refreshLens(pane);
  if (TURNS[key] && pane.camera.mode === "path") {
    this.actions.step(TURNS[key][0] - TURNS[key][1]);
  } else if (TURNS[key]) {
    pane.camera.turn(-24 * TURNS[key][0], -24 * TURNS[key][1], pane.rect.height);
    this.actions.moved(pane.camera);
  } else if (ZOOMS[key]) {
    pane.camera.zoom(ZOOMS[key]);
    this.actions.moved(pane.camera);
  } else if (STEPS[key]) {
    this.keys.add(key);
    this.walk();
  } else if (!this.actions.key(key, pane, e.shiftKey)) {
    return;
  }
  e.preventDefault();
};

// Walks while keys are down, at a speed that crosses the map in about six seconds.
Input.prototype.walk = function () {
  if (this.isWalking) return;
  this.isWalking = true;
  let last = null;
  const step = function (now) {
    const pane = this.view.cursor.pane;
    if (this.keys.size === 0) {
      this.isWalking = false;
      this.view.isMoving = false;
      this.view.request();
      return;
    }
    const seconds = last === null ? 1 / 60 : Math.min(0.1, (now - last) / 1000);
    last = now;
    let direction = [0, 0, 0];
    this.keys.forEach(function (key) { direction = add(direction, STEPS[key]); });
    this.view.isMoving = true;
    pane.camera.go(scaled(direction, seconds * this.view.bounds.radius / 3));
    this.actions.moved(pane.camera);
    requestAnimationFrame(step);
  }.bind(this);
  requestAnimationFrame(step);
};
