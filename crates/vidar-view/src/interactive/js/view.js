// The view: panes, cameras, what is shown, and one picture of it.

function View(canvas, overlay, gl, data) {
  this.canvas = canvas;
  this.overlay = overlay;
  this.gl = gl;
  this.up = data.up;
  this.maps = { sea: bytesOf(data.maps.sea), ember: bytesOf(data.maps.ember) };
  this.panes = data.panes.map(paneOf);
  this.coloring = data.coloring;
  this.show = { mesh: true, cloud: true, estimate: true, truth: true, keyframes: true };
  this.looksInside = true;
  this.isLinked = true;
  this.isMoving = false;
  this.measurement = new Measurement();
  this.cursor = { pane: this.panes[0], x: 0, y: 0, isKeyboard: false };
  this.hovered = null;
  this.density = 1;
  this.frames = 0;
  this.programs = {
    surface: programOf(gl, SURFACE_VERTEX, SURFACE_FRAGMENT),
    line: programOf(gl, LINE_VERTEX, LINE_FRAGMENT),
  };
  const basis = basisOf(this.up);
  this.bounds = boundsOf(this.panes, basis);
  this.heights = this.bounds.heights;
  this.cut = 1e30;
  // Long enough to be pointed at, short enough not to hide the room.
  this.reach = 0.022 * this.bounds.radius;
  this.panes.forEach(function (pane, i) {
    pane.isShown = data.shown === "all" || i === 0;
    pane.camera = new Camera(basis, this.bounds);
    uploadSurface(gl, pane.mesh);
    uploadSurface(gl, pane.cloud);
  }, this);
  this.readColors();
  recolor(this);
}

// Middle, half extents along right, away and up, and radius of what the panes show, without the outermost percent; and some of its
// places.
function boundsOf(panes, basis) {
  const MOST_SAMPLES = 20000;
  const MOST_PLACES = 3000;
  const along = [[], [], []];
  const samples = [];
  panes.forEach(function (pane) {
    const surface = pane.mesh || pane.cloud;
    const paths = pane.paths.flatMap(function (p) { return p.poses.map(function (q) { return q.position; }); });
    const count = surface ? surface.count : 0;
    const every = Math.max(1, Math.floor(count / MOST_SAMPLES));
    const places = count ? [] : paths;
    for (let i = 0; i < count; i += every) places.push(pointOf(surface, i));
    const everyPlace = Math.max(1, Math.floor(count / MOST_PLACES));
    for (let i = 0; i < count; i += everyPlace) {
      const n = [0, 1, 2].map(function (k) { return surface.normals[4 * i + k]; });
      samples.push({ place: pointOf(surface, i), normal: surface.hasNormals ? n : null });
    }
    if (count === 0) paths.forEach(function (p) { samples.push({ place: p, normal: null }); });
    places.forEach(function (p) {
      [basis.right, basis.away, basis.up].forEach(function (axis, k) { along[k].push(dot(p, axis)); });
    });
  });
  const ends = along.map(function (values) {
    values.sort(function (a, b) { return a - b; });
    const trim = Math.floor(values.length / 100);
    return values.length ? [values[trim], values[values.length - 1 - trim]] : [-1, 1];
  });
  const half = ends.map(function (e) { return Math.max((e[1] - e[0]) / 2, 1e-3); });
  const middle = ends.map(function (e) { return (e[0] + e[1]) / 2; });
  const center = [basis.right, basis.away, basis.up].reduce(function (sum, axis, k) {
    return add(sum, scaled(axis, middle[k]));
  }, [0, 0, 0]);
  if (samples.length === 0) samples.push({ place: center, normal: null });
  return { center: center, half: half, radius: length(half), heights: ends[2], samples: samples };
}

// Colours of the page, which follow the reader's light or dark.
View.prototype.readColors = function () {
  const style = getComputedStyle(document.documentElement);
  const css = function (name) { return style.getPropertyValue(name).trim(); };
  const isDark = matchMedia("(prefers-color-scheme: dark)").matches;
  this.colors = {
    paper: css("--paper"),
    ink: css("--ink"),
    line: css("--line"),
    background: isDark ? [0.11, 0.125, 0.14] : [0.945, 0.95, 0.957],
    estimate: [0, 0.447, 0.698, 1],
    truth: isDark ? [0.95, 0.95, 0.95, 1] : [0.12, 0.12, 0.12, 1],
    keyframe: isDark ? [0.95, 0.66, 0.2, 0.85] : [0.835, 0.369, 0, 0.8],
    hovered: [0.79, 0.08, 0.54, 1],
  };
  this.panes.forEach(function (pane) { uploadLines(this, pane); }, this);
};

View.prototype.shownPanes = function () {
  return this.panes.filter(function (p) { return p.isShown; });
};

// Rectangles of the visible panes in CSS pixels: side by side where the view is wide, else one below the other.
View.prototype.layout = function () {
  const width = this.canvas.clientWidth;
  const height = this.canvas.clientHeight;
  const shown = this.shownPanes();
  const n = shown.length;
  const columns = n === 4 ? 2 : width > height ? n : 1;
  const rows = Math.ceil(n / columns);
  shown.forEach(function (pane, i) {
    const column = i % columns;
    const row = Math.floor(i / columns);
    pane.rect = {
      x: column * width / columns,
      y: row * height / rows,
      width: width / columns,
      height: height / rows,
    };
  });
  return shown;
};

View.prototype.resize = function () {
  // More than two device pixels per pixel cost time and show nothing more.
  this.density = Math.min(window.devicePixelRatio || 1, 2);
  [this.canvas, this.overlay].forEach(function (c) {
    const width = Math.max(1, Math.round(c.clientWidth * this.density));
    const height = Math.max(1, Math.round(c.clientHeight * this.density));
    if (c.width !== width || c.height !== height) {
      c.width = width;
      c.height = height;
    }
  }, this);
};

View.prototype.request = function () {
  if (this.isRequested) return;
  this.isRequested = true;
  const view = this;
  requestAnimationFrame(function () {
    view.isRequested = false;
    view.draw();
  });
};

View.prototype.draw = function () {
  this.resize();
  const gl = this.gl;
  const context = this.overlay.getContext("2d");
  context.setTransform(this.density, 0, 0, this.density, 0, 0);
  context.clearRect(0, 0, this.overlay.width, this.overlay.height);
  gl.enable(gl.DEPTH_TEST);
  gl.depthFunc(gl.LEQUAL);
  gl.enable(gl.SCISSOR_TEST);
  this.layout().forEach(function (pane) {
    const rect = pane.rect;
    const lens = pane.camera.lens(rect.width, rect.height);
    pane.lens = lens;
    const d = this.density;
    const box = [rect.x * d, this.canvas.height - (rect.y + rect.height) * d, rect.width * d, rect.height * d].map(Math.round);
    gl.viewport(box[0], box[1], box[2], box[3]);
    gl.scissor(box[0], box[1], box[2], box[3]);
    const c = this.colors.background;
    gl.clearColor(c[0], c[1], c[2], 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    if (pane.mesh && this.show.mesh) drawSurface(this, lens, pane.mesh);
    if (pane.cloud && (this.show.cloud || !pane.mesh)) drawSurface(this, lens, pane.cloud);
    this.drawLines(pane, lens);
    drawOverlay(context, this, pane, rect, lens);
  }, this);
  this.frames++;
};

View.prototype.drawLines = function (pane, lens) {
  // Lines that run through the eye would fill the picture.
  if (pane.camera.mode === "path") return;
  if (this.show.truth) drawLines(this, lens, pane.lines.truth, 2, 0.35);
  if (this.show.estimate) drawLines(this, lens, pane.lines.estimate, 2.5, 0.35);
  if (!this.show.keyframes) return;
  drawLines(this, lens, pane.lines.keyframes, 1.3, 0.12);
  if (this.hovered && pane.keyframes.indexOf(this.hovered) >= 0) {
    const ribbons = ribbonsOf(this.gl, frustumSegments(this.hovered, this.reach, this.colors.hovered));
    drawLines(this, lens, ribbons, 3, 0.6);
    this.gl.deleteBuffer(ribbons.buffer);
  }
};

// Distance at which the scale bar holds: that of the point turned about, else of what is in the middle. A ray through a mesh
// takes some milliseconds, so it waits for the end of a movement.
View.prototype.depthInMiddle = function (pane, lens) {
  if (lens.isParallel || pane.camera.mode === "orbit") return pane.camera.distance;
  if (!this.isMoving || !pane.middleDepth) {
    const hit = this.hit(pane, lens, lens.width / 2, lens.height / 2);
    pane.middleDepth = hit ? dot(subtract(hit.point, lens.frame.eye), lens.frame.forward) : this.bounds.radius;
  }
  return pane.middleDepth;
};

// What a pixel of a pane shows: the nearest of mesh and points.
View.prototype.hit = function (pane, lens, x, y) {
  const ray = rayOf(lens, x, y);
  const mesh = pane.mesh && this.show.mesh ? hitMesh(pane.mesh, ray, this) : null;
  if (mesh || !pane.cloud || pane.mesh && !this.show.cloud) return mesh;
  return hitCloud(pane.cloud, ray, lens, this);
};

// The visible pane at a place of the canvas.
View.prototype.paneAt = function (x, y) {
  return this.layout().find(function (p) {
    const r = p.rect;
    return x >= r.x && x < r.x + r.width && y >= r.y && y < r.y + r.height;
  }) || this.shownPanes()[0];
};

// What is clicked must be what the camera shows now, also before the next picture is drawn.
View.prototype.refreshLens = function (pane) {
  pane.lens = pane.camera.lens(pane.rect.width, pane.rect.height);
};

// After a camera moved: the others follow where they are linked.
View.prototype.moved = function (camera) {
  if (this.isLinked) {
    this.panes.forEach(function (p) { if (p.camera !== camera) p.camera.copy(camera); });
  }
  this.request();
};

View.prototype.setColoring = function (coloring) {
  this.coloring = coloring;
  recolor(this);
  this.request();
};

// share 0 to 1 of the height; 1 cuts nothing.
View.prototype.setCut = function (share) {
  const h = this.bounds.heights;
  this.cut = share >= 1 ? 1e30 : h[0] + share * (h[1] - h[0]);
  this.request();
};

// The path that a pane flies along.
View.prototype.pathOf = function (pane) {
  return pane.paths.find(function (p) { return p.role === "estimate" && p.poses.length > 1; }) || null;
};

// The pane that flies: the first visible one with a path.
View.prototype.flyingPane = function () {
  return this.shownPanes().find(this.pathOf, this) || this.panes.find(this.pathOf, this) || null;
};

// Seconds from the first pose of a path to its last.
function pathSeconds(path) { return path.poses[path.poses.length - 1].time; }

// Puts the camera of the flying pane to a share of the path's time.
View.prototype.fly = function (share) {
  const pane = this.flyingPane();
  if (!pane) return null;
  const path = this.pathOf(pane);
  const time = share * pathSeconds(path);
  pane.camera.mode = "path";
  pane.camera.pose = poseAt(path, time);
  const keyframe = pane.keyframes[0];
  // The angle of view of the camera itself.
  if (keyframe) pane.camera.halfHeight = Math.max(Math.abs(keyframe.edges[1]), Math.abs(keyframe.edges[3]));
  this.moved(pane.camera);
  return { time: time, length: pathSeconds(path) };
};

// Looks from a keyframe.
View.prototype.lookFrom = function (pane, keyframe) {
  pane.camera.mode = "path";
  pane.camera.pose = { position: keyframe.position, rotation: keyframe.rotation };
  pane.camera.halfHeight = Math.max(Math.abs(keyframe.edges[1]), Math.abs(keyframe.edges[3]));
  this.moved(pane.camera);
};
