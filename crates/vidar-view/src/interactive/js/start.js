// Builds the view when the page is there.

function contextOf(canvas) {
  const wish = { antialias: true, alpha: false, preserveDrawingBuffer: false, powerPreference: "high-performance" };
  const second = canvas.getContext("webgl2", wish);
  if (second) return second;
  const first = canvas.getContext("webgl", wish);
  // Meshes have more than 65536 vertices.
  return first && first.getExtension("OES_element_index_uint") ? first : null;
}

function start() {
  const byId = function (id) { return document.getElementById(id); };
  const body = byId("view-body");
  const canvas = byId("view-canvas");
  const gl = window.location.hash === "#no-webgl" ? null : contextOf(canvas);
  if (!gl) {
    byId("view-none").hidden = false;
    return;
  }
  body.hidden = false;
  const data = JSON.parse(byId("view-data").textContent);
  const view = new View(canvas, byId("view-overlay"), gl, data);
  const controls = new Controls(view);
  new Input(view, controls);
  if (window.ResizeObserver) new ResizeObserver(function () { view.request(); }).observe(canvas);
  window.addEventListener("resize", function () { view.request(); });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", function () {
    view.readColors();
    view.request();
  });
  canvas.addEventListener("webglcontextlost", function () {
    body.hidden = true;
    byId("view-none").hidden = false;
    byId("view-none").textContent = "The graphics processor was taken away from this page; load it again.";
  });
  view.draw();
  window.vidarView = handleOf(view, controls);
}

// For scripts: what the console of a browser, and the tests, ask and set.
function handleOf(view, controls) {
  const pane = function (i) { return view.panes[i || 0]; };
  return {
    // Pixel of a point of the world on the canvas.
    project: function (point, i) {
      view.draw();
      const at = pixelOf(pane(i).lens, point);
      return at ? { x: at.x + pane(i).rect.x, y: at.y + pane(i).rect.y, depth: at.depth } : null;
    },
    // Length of a pixel at a depth.
    pixelLength: function (depth, i) { return pixelLength(pane(i).lens, depth); },
    // The measurement as it stands.
    measurement: function () {
      const m = view.measurement;
      return { points: m.points, value: m.value(), text: m.pane && m.value() !== null ? measured(m.pane, m.value()) : "" };
    },
    state: function (i) {
      const p = pane(i);
      return {
        mode: p.camera.mode,
        eye: p.camera.frame().eye,
        forward: p.camera.frame().forward,
        coloring: view.coloring,
        shown: view.panes.map(function (q) { return q.isShown; }),
        triangles: p.mesh ? p.mesh.indices.length / 3 : 0,
        points: p.cloud ? p.cloud.count : 0,
        step: p.mesh ? p.mesh.step : null,
        keyframes: p.keyframes.map(function (k) { return { frame: k.frame, position: k.position }; }),
        hovered: view.hovered ? view.hovered.frame : null,
        scaleBar: p.scaleBar,
        heights: view.heights,
        frames: view.frames,
      };
    },
    vertex: function (i, n) { return pointOf(pane(i).mesh, n); },
    // Looks from a place at another.
    look: function (eye, at) {
      pane(0).camera.look({ eye: eye, forward: unit(subtract(at, eye)) }, "walk");
      view.moved(pane(0).camera);
      controls.showMode("walk");
      view.draw();
    },
    // Mean milliseconds of a frame while turning, until its pixels are there.
    frameTime: function (count) {
      const pixel = new Uint8Array(4);
      const begin = performance.now();
      for (let k = 0; k < count; k++) {
        const camera = view.shownPanes()[0].camera;
        camera.turn(2, 0, 600);
        view.moved(camera);
        view.draw();
        view.gl.readPixels(0, 0, 1, 1, view.gl.RGBA, view.gl.UNSIGNED_BYTE, pixel);
      }
      return (performance.now() - begin) / count;
    },
    // Shares of pixels that are not background, and the mean colour, of what is drawn now.
    pixels: function () {
      view.draw();
      const gl = view.gl;
      const width = view.canvas.width;
      const height = view.canvas.height;
      const data = new Uint8Array(4 * width * height);
      gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, data);
      const back = view.colors.background.map(function (c) { return Math.round(255 * c); });
      let drawn = 0;
      let hash = 0;
      const mean = [0, 0, 0];
      for (let k = 0; k < data.length; k += 4) {
        const isBack = [0, 1, 2].every(function (j) { return Math.abs(data[k + j] - back[j]) <= 2; });
        if (isBack) continue;
        drawn++;
        for (let j = 0; j < 3; j++) mean[j] += data[k + j];
        hash = (hash * 31 + data[k] + 7 * data[k + 1] + 13 * data[k + 2] + k) >>> 0;
      }
      return { share: 4 * drawn / data.length, mean: mean.map(function (m) { return m / Math.max(1, drawn); }), hash: hash };
    },
  };
}

start();
