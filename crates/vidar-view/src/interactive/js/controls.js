// Buttons, lists and sliders of the page, and what clicks and keys on the view do.

function Controls(view) {
  this.view = view;
  this.isPlaying = false;
  this.hintTimer = 0;
  this.byId = function (id) { return document.getElementById("view-" + id); };
  this.bindCamera();
  this.bindShow();
  this.bindColoring();
  this.bindFlight();
}

Controls.prototype.on = function (id, event, f) {
  const element = this.byId(id);
  if (element) element.addEventListener(event, f.bind(this));
};

Controls.prototype.say = function (text) { this.byId("status").textContent = text; };

Controls.prototype.moved = function (camera) {
  this.stop();
  this.view.moved(camera);
  this.showMode(camera.mode);
};

// Radio buttons and the flight's slider follow the camera: a drag on the path ends the flight.
Controls.prototype.showMode = function (mode) {
  document.querySelectorAll("input[name=view-camera]").forEach(function (radio) { radio.checked = radio.value === mode; });
  const flight = this.byId("flight");
  if (flight) flight.hidden = mode !== "path";
};

Controls.prototype.camera = function () {
  const pane = this.view.cursor.pane;
  return (pane.isShown ? pane : this.view.shownPanes()[0]).camera;
};

Controls.prototype.setMode = function (mode) {
  this.stop();
  if (mode === "path") {
    this.flyTo(Number(this.byId("time").value) / 1000);
  } else {
    this.camera().setMode(mode);
    this.view.moved(this.camera());
  }
  this.showMode(mode);
};

Controls.prototype.bindCamera = function () {
  document.querySelectorAll("input[name=view-camera]").forEach(function (radio) {
    radio.addEventListener("change", function () { if (radio.checked) this.setMode(radio.value); }.bind(this));
  }, this);
  this.on("home", "click", function () { this.camera().home(); this.moved(this.camera()); });
  this.on("top", "click", function () { this.camera().fromAbove(); this.moved(this.camera()); });
  this.on("measure", "click", function () { this.setMeasuring(!this.view.measurement.isOn); });
  this.on("parallel", "change", function (e) { this.camera().isParallel = e.target.checked; this.view.moved(this.camera()); });
  this.on("linked", "change", function (e) { this.view.isLinked = e.target.checked; if (e.target.checked) this.view.moved(this.camera()); });
  this.on("full", "click", function () {
    const stage = this.byId("stage");
    if (document.fullscreenElement) document.exitFullscreen(); else if (stage.requestFullscreen) stage.requestFullscreen();
  });
};

Controls.prototype.bindShow = function () {
  const view = this.view;
  [["mesh", "mesh"], ["cloud", "cloud"], ["path", "estimate"], ["truth", "truth"], ["keyframes", "keyframes"]].forEach(function (pair) {
    const box = this.byId("show-" + pair[0]);
    view.show[pair[1]] = box !== null && box.checked;
    this.on("show-" + pair[0], "change", function (e) { view.show[pair[1]] = e.target.checked; view.request(); });
  }, this);
  this.on("inside", "change", function (e) { view.looksInside = e.target.checked; view.request(); });
  this.on("cut", "input", function (e) {
    const share = Number(e.target.value) / 100;
    view.setCut(share);
    const h = view.bounds.heights;
    this.byId("cut-text").textContent = share >= 1 ? "nothing" : shortLength(share * (h[1] - h[0]), view.panes[0].isMetric) + " over the lowest";
  });
  view.panes.forEach(function (pane, i) {
    this.on("pane-" + i, "change", function (e) {
      pane.isShown = e.target.checked;
      // One pane stays.
      if (view.shownPanes().length === 0) { pane.isShown = true; e.target.checked = true; }
      view.moved(this.camera());
    });
  }, this);
};

Controls.prototype.bindColoring = function () {
  this.on("coloring", "change", function (e) { this.view.setColoring(e.target.value); });
};

// The next colouring that is available.
Controls.prototype.nextColoring = function () {
  const list = this.byId("coloring");
  let i = list.selectedIndex;
  do { i = (i + 1) % list.options.length; } while (list.options[i].disabled);
  list.selectedIndex = i;
  this.view.setColoring(list.value);
  this.say("Colours: " + list.options[i].textContent + ".");
};

Controls.prototype.bindFlight = function () {
  this.on("time", "input", function (e) { this.stop(); this.flyTo(Number(e.target.value) / 1000); });
  this.on("play", "click", function () { if (this.isPlaying) this.stop(); else this.play(); });
};

Controls.prototype.flyTo = function (share) {
  const flown = this.view.fly(share);
  if (!flown) return;
  this.byId("time").value = String(Math.round(1000 * share));
  this.byId("time-text").textContent = flown.time.toFixed(1) + " of " + flown.length.toFixed(1) + " s";
  this.showMode("path");
};

Controls.prototype.step = function (direction) {
  this.stop();
  this.flyTo(clamped(Number(this.byId("time").value) / 1000 + 0.01 * direction, 0, 1));
};

Controls.prototype.stop = function () {
  if (!this.isPlaying) return;
  this.isPlaying = false;
  this.view.isMoving = false;
  this.byId("play").setAttribute("aria-pressed", "false");
  this.byId("play").textContent = "Play";
  this.view.request();
};

// In the time that the recording took.
Controls.prototype.play = function () {
  const pane = this.view.flyingPane();
  if (!pane) return;
  const seconds = Math.max(pathSeconds(this.view.pathOf(pane)), 1e-3);
  const slider = this.byId("time");
  const start = Number(slider.value) >= 1000 ? 0 : Number(slider.value) / 1000;
  let first = null;
  this.isPlaying = true;
  this.view.isMoving = true;
  this.byId("play").setAttribute("aria-pressed", "true");
  this.byId("play").textContent = "Pause";
  const step = function (now) {
    if (!this.isPlaying) return;
    if (first === null) first = now;
    const share = start + (now - first) / 1000 / seconds;
    this.flyTo(Math.min(share, 1));
    if (share >= 1) this.stop(); else requestAnimationFrame(step);
  }.bind(this);
  this.flyTo(start);
  requestAnimationFrame(step);
};

Controls.prototype.setMeasuring = function (isOn) {
  const m = this.view.measurement;
  m.isOn = isOn;
  m.clear();
  this.byId("measure").setAttribute("aria-pressed", String(isOn));
  this.view.canvas.classList.toggle("is-measuring", isOn);
  this.say(isOn ? m.text() : "");
  this.view.request();
};

// A point of the surface at a place of a pane; with Shift the nearest vertex.
Controls.prototype.takePoint = function (pane, x, y, isSnapped) {
  const hit = this.view.hit(pane, pane.lens, x, y);
  if (!hit) return this.say("There is no surface here. " + this.view.measurement.text());
  this.view.measurement.take(pane, isSnapped ? hit.vertex : hit.point);
  this.say(this.view.measurement.text());
  this.view.request();
};

Controls.prototype.click = function (place, isShift) {
  if (this.view.measurement.isOn) return this.takePoint(place.pane, place.x, place.y, isShift);
  const keyframe = this.view.show.keyframes ? keyframeAt(this.view, place.pane, place.pane.lens, place.x, place.y) : null;
  if (!keyframe || place.pane.camera.mode === "path") return;
  this.view.lookFrom(place.pane, keyframe);
  this.showMode("path");
  this.hover(null);
  this.say("Looking from keyframe " + keyframe.frame + ".");
};

// Image and depth of the keyframe under the pointer.
Controls.prototype.hover = function (place) {
  const view = this.view;
  const isShown = place && view.show.keyframes && place.pane.lens && place.pane.camera.mode !== "path" && !view.measurement.isOn;
  const found = isShown ? keyframeAt(view, place.pane, place.pane.lens, place.x, place.y) : null;
  view.canvas.classList.toggle("is-on-keyframe", found !== null);
  if (found !== view.hovered) {
    view.hovered = found;
    view.request();
    this.showKeyframe(found, place);
  }
};

Controls.prototype.showKeyframe = function (keyframe, place) {
  const card = this.byId("keyframe");
  card.hidden = !keyframe;
  if (!keyframe) return;
  this.byId("keyframe-name").textContent = "Keyframe " + keyframe.frame;
  const picture = function (id, kind, base64) {
    const image = this.byId(id);
    image.hidden = !base64;
    if (base64) image.src = "data:image/" + kind + ";base64," + base64;
  }.bind(this);
  picture("keyframe-image", "jpeg", keyframe.image);
  picture("keyframe-depth", "png", keyframe.depth);
  const range = keyframe.depthRange;
  const length = function (v) { return shortLength(v, place.pane.isMetric); };
  this.byId("keyframe-depth-range").textContent = range ? length(range[0]) + " bright, " + length(range[1]) + " dark" : "no depth";
  // Beside the pointer, on the side where there is more room.
  const view = this.view.canvas;
  const isLeft = place.canvasX > view.clientWidth / 2;
  card.style.left = isLeft ? "auto" : place.canvasX + 18 + "px";
  card.style.right = isLeft ? view.clientWidth - place.canvasX + 18 + "px" : "auto";
  const room = Math.max(0, view.clientHeight - card.offsetHeight - 8);
  card.style.top = clamped(place.canvasY - 40, 8, Math.max(8, room)) + "px";
};

// Other keys of the view; whether the key has a meaning.
Controls.prototype.key = function (key, pane, isShift) {
  const m = this.view.measurement;
  const modes = { 1: "orbit", 2: "walk", 3: "path" };
  const path = document.querySelector("input[name=view-camera][value=path]");
  if (modes[key]) {
    if (modes[key] !== "path" || !path.disabled) this.setMode(modes[key]);
  } else if (key === "home") {
    pane.camera.home();
    this.moved(pane.camera);
  } else if (key === "t") {
    pane.camera.fromAbove();
    this.moved(pane.camera);
  } else if (key === "c") {
    this.nextColoring();
  } else if (key === "m") {
    this.setMeasuring(!m.isOn);
  } else if (key === "p" && !path.disabled) {
    if (this.isPlaying) this.stop(); else this.play();
  } else if (key === "enter" && m.isOn) {
    this.takePoint(pane, pane.rect.width / 2, pane.rect.height / 2, isShift);
  } else if (key === "escape" && m.isOn) {
    this.setMeasuring(false);
  } else {
    return false;
  }
  return true;
};

Controls.prototype.hint = function () {
  const hint = this.byId("hint");
  hint.hidden = false;
  clearTimeout(this.hintTimer);
  this.hintTimer = setTimeout(function () { hint.hidden = true; }, 1500);
};
