// Trajectories and frusta as ribbons.

const FLOATS_PER_CORNER = 12;
const CORNERS = [[0, -1], [1, -1], [1, 1], [0, -1], [1, 1], [0, 1]];

// segments: [from, to, [r, g, b, opacity]] with colours 0 to 1.
function ribbonsOf(gl, segments) {
  const data = new Float32Array(segments.length * CORNERS.length * FLOATS_PER_CORNER);
  let at = 0;
  segments.forEach(function (s) {
    CORNERS.forEach(function (corner) {
      data.set(s[0], at);
      data.set(s[1], at + 3);
      data.set(corner, at + 6);
      data.set(s[2], at + 8);
      at += FLOATS_PER_CORNER;
    });
  });
  return { buffer: uploaded(gl, gl.ARRAY_BUFFER, data), count: segments.length * CORNERS.length };
}

function pathSegments(path, color) {
  const segments = [];
  for (let i = 1; i < path.poses.length; i++) {
    segments.push([path.poses[i - 1].position, path.poses[i].position, color]);
  }
  return segments;
}

function frustumSegments(keyframe, reach, color) {
  const corners = cornersOf(keyframe, reach);
  const segments = [];
  corners.forEach(function (corner, i) {
    segments.push([keyframe.position, corner, color]);
    segments.push([corner, corners[(i + 1) % 4], color]);
  });
  return segments;
}

function uploadLines(view, pane) {
  const gl = view.gl;
  const of = function (role) {
    const paths = pane.paths.filter(function (p) { return p.role === role; });
    const segments = paths.flatMap(function (p) { return pathSegments(p, view.colors[role]); });
    return segments.length ? ribbonsOf(gl, segments) : null;
  };
  const frusta = pane.keyframes.flatMap(function (k) { return frustumSegments(k, view.reach, view.colors.keyframe); });
  pane.lines = { estimate: of("estimate"), truth: of("truth"), keyframes: frusta.length ? ribbonsOf(gl, frusta) : null };
}

// Twice: faintly through everything, then clearly where nothing is in front.
function drawLines(view, lens, ribbons, width, hiddenOpacity) {
  if (!ribbons) return;
  const gl = view.gl;
  const p = view.programs.line;
  gl.useProgram(p.program);
  gl.bindBuffer(gl.ARRAY_BUFFER, ribbons.buffer);
  [["from", 3, 0], ["to", 3, 12], ["corner", 2, 24], ["color", 4, 32]].forEach(function (a) {
    gl.enableVertexAttribArray(p.attribute[a[0]]);
    gl.vertexAttribPointer(p.attribute[a[0]], a[1], gl.FLOAT, false, 4 * FLOATS_PER_CORNER, a[2]);
  });
  gl.uniformMatrix4fv(p.uniform.clipFromWorld, false, lens.clipFromWorld);
  gl.uniform2f(p.uniform.viewport, lens.width, lens.height);
  gl.uniform1f(p.uniform.width, width);
  gl.uniform1f(p.uniform.near, lens.isParallel ? 0 : lens.near);
  gl.enable(gl.BLEND);
  gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  gl.depthMask(false);
  [[gl.ALWAYS, hiddenOpacity], [gl.LEQUAL, 1]].forEach(function (pass) {
    gl.depthFunc(pass[0]);
    gl.uniform1f(p.uniform.opacity, pass[1]);
    gl.drawArrays(gl.TRIANGLES, 0, ribbons.count);
  });
  gl.depthFunc(gl.LEQUAL);
  gl.depthMask(true);
  gl.disable(gl.BLEND);
  releaseAttributes(gl, p);
}

function isInside(polygon, x, y) {
  let inside = false;
  polygon.forEach(function (a, i) {
    const b = polygon[(i + 1) % polygon.length];
    if (a.y > y !== b.y > y && x < (b.x - a.x) * (y - a.y) / (b.y - a.y) + a.x) inside = !inside;
  });
  return inside;
}

// The keyframe whose frustum is under a pixel: the nearest of those whose image plane or centre is there.
function keyframeAt(view, pane, lens, x, y) {
  const NEAR_PX = 9;
  let best = null;
  pane.keyframes.forEach(function (keyframe) {
    const apex = pixelOf(lens, keyframe.position);
    const corners = cornersOf(keyframe, view.reach).map(function (c) { return pixelOf(lens, c); });
    if (!apex || corners.indexOf(null) >= 0 || isAtEye(view, lens, keyframe)) return;
    const isNear = Math.hypot(apex.x - x, apex.y - y) < NEAR_PX || isInside(corners, x, y);
    if (isNear && (!best || apex.depth < best.depth)) best = { keyframe: keyframe, depth: apex.depth };
  });
  return best ? best.keyframe : null;
}

// A frustum round the eye would only be in the way.
function isAtEye(view, lens, keyframe) {
  return !lens.isParallel && distance(keyframe.position, lens.frame.eye) < 2 * view.reach;
}
