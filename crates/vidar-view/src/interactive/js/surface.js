// Meshes and clouds on the graphics processor: their colours, drawing, and what a ray hits.

const PLASTER = [214, 209, 200];
const WITHOUT_VALUE = [150, 150, 152];
// Shares of light that an edge-on surface loses, as in the pictures: colours that stand for values are dimmed less.
const LIGHT_OF_COLORS = 0.3;
const LIGHT_OF_VALUES = 0.22;

function uploaded(gl, kind, data) {
  const buffer = gl.createBuffer();
  gl.bindBuffer(kind, buffer);
  gl.bufferData(kind, data, gl.STATIC_DRAW);
  return buffer;
}

function uploadSurface(gl, surface) {
  if (!surface) return;
  surface.buffers = {
    position: uploaded(gl, gl.ARRAY_BUFFER, new Float32Array(surface.positions)),
    normal: uploaded(gl, gl.ARRAY_BUFFER, surface.normals),
    color: gl.createBuffer(),
    index: surface.indices ? uploaded(gl, gl.ELEMENT_ARRAY_BUFFER, surface.indices) : null,
  };
}

// One colour per vertex. `coloring` is "color", "height" or the id of a field; the range of heights is that of all panes.
function colorsOf(surface, pane, coloring, view) {
  const out = new Uint8Array(4 * surface.count);
  const index = pane.fields.findIndex(function (f) { return f.id === coloring; });
  const values = index >= 0 ? surface.values[index] : null;
  const table = values ? view.maps[pane.fields[index].map] : view.maps.sea;
  const low = view.heights[0];
  const range = Math.max(view.heights[1] - low, 1e-9);
  for (let i = 0; i < surface.count; i++) {
    let color = PLASTER;
    let from = 0;
    if (coloring === "height") {
      const p = surface.positions;
      const height = p[3 * i] * view.up[0] + p[3 * i + 1] * view.up[1] + p[3 * i + 2] * view.up[2];
      color = table;
      from = 3 * Math.round(254 * clamped((height - low) / range, 0, 1));
    } else if (values) {
      if (values[i] === NO_VALUE) { color = WITHOUT_VALUE; } else { color = table; from = 3 * values[i]; }
    } else if (coloring !== "color") {
      color = WITHOUT_VALUE;
    } else if (surface.colors) {
      color = surface.colors;
      from = 3 * i;
    }
    out[4 * i] = color[from];
    out[4 * i + 1] = color[from + 1];
    out[4 * i + 2] = color[from + 2];
    out[4 * i + 3] = 255;
  }
  return out;
}

function recolor(view) {
  const gl = view.gl;
  view.panes.forEach(function (pane) {
    [pane.mesh, pane.cloud].forEach(function (surface) {
      if (!surface) return;
      gl.bindBuffer(gl.ARRAY_BUFFER, surface.buffers.color);
      gl.bufferData(gl.ARRAY_BUFFER, colorsOf(surface, pane, view.coloring, view), gl.STATIC_DRAW);
    });
  });
}

function drawSurface(view, lens, surface) {
  const gl = view.gl;
  const p = view.programs.surface;
  gl.useProgram(p.program);
  const bind = function (name, buffer, size, type, isNormalised, stride) {
    const at = p.attribute[name];
    if (at === undefined || at < 0) return;
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.enableVertexAttribArray(at);
    gl.vertexAttribPointer(at, size, type, isNormalised, stride, 0);
  };
  bind("position", surface.buffers.position, 3, gl.FLOAT, false, 12);
  bind("normal", surface.buffers.normal, 3, gl.BYTE, true, 4);
  bind("color", surface.buffers.color, 3, gl.UNSIGNED_BYTE, true, 4);
  const isPoint = surface.indices === null;
  const isColor = view.coloring === "color";
  // A little more than the distance of neighbours, so that points of a wall touch.
  const pixels = 1.3 * surface.spacing * view.density * lens.height / (2 * lens.halfHeight);
  gl.uniformMatrix4fv(p.uniform.clipFromWorld, false, lens.clipFromWorld);
  gl.uniform3fv(p.uniform.eye, lens.frame.eye);
  gl.uniform3fv(p.uniform.forward, lens.frame.forward);
  gl.uniform3fv(p.uniform.up, view.up);
  gl.uniform1f(p.uniform.isParallel, lens.isParallel ? 1 : 0);
  gl.uniform1f(p.uniform.light, isColor ? (surface.colors ? LIGHT_OF_COLORS : 0.55) : LIGHT_OF_VALUES);
  gl.uniform1f(p.uniform.pointPixels, pixels);
  gl.uniform1f(p.uniform.isPoint, isPoint ? 1 : 0);
  gl.uniform1f(p.uniform.cullsPoints, view.looksInside ? 1 : 0);
  gl.uniform1f(p.uniform.cut, view.cut);
  if (view.looksInside) gl.enable(gl.CULL_FACE); else gl.disable(gl.CULL_FACE);
  // Lines that lie on the surface must win against it.
  gl.enable(gl.POLYGON_OFFSET_FILL);
  gl.polygonOffset(1, 1);
  if (isPoint) {
    gl.drawArrays(gl.POINTS, 0, surface.count);
  } else {
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, surface.buffers.index);
    gl.drawElements(gl.TRIANGLES, surface.indices.length, gl.UNSIGNED_INT, 0);
  }
  gl.disable(gl.POLYGON_OFFSET_FILL);
  gl.disable(gl.CULL_FACE);
  releaseAttributes(gl, p);
}

// The nearest hit of a ray with the mesh (Moeller and Trumbore 1997), as drawn: not above the cut, not from behind where one looks
// through walls. Null, or the point and the nearest vertex of its triangle.
function hitMesh(surface, ray, view) {
  const p = surface.positions;
  const ids = surface.indices;
  const o = ray.origin;
  const d = ray.direction;
  let nearest = Infinity;
  let triangle = -1;
  for (let t = 0; t < ids.length; t += 3) {
    const a = 3 * ids[t];
    const b = 3 * ids[t + 1];
    const c = 3 * ids[t + 2];
    const ax = p[a], ay = p[a + 1], az = p[a + 2];
    const e1x = p[b] - ax, e1y = p[b + 1] - ay, e1z = p[b + 2] - az;
    const e2x = p[c] - ax, e2y = p[c + 1] - ay, e2z = p[c + 2] - az;
    const hx = d[1] * e2z - d[2] * e2y, hy = d[2] * e2x - d[0] * e2z, hz = d[0] * e2y - d[1] * e2x;
    const det = e1x * hx + e1y * hy + e1z * hz;
    // Positive: the triangle is seen from its front.
    if (view.looksInside ? det < 1e-15 : Math.abs(det) < 1e-15) continue;
    const sx = o[0] - ax, sy = o[1] - ay, sz = o[2] - az;
    const u = (sx * hx + sy * hy + sz * hz) / det;
    if (u < 0 || u > 1) continue;
    const qx = sy * e1z - sz * e1y, qy = sz * e1x - sx * e1z, qz = sx * e1y - sy * e1x;
    const v = (d[0] * qx + d[1] * qy + d[2] * qz) / det;
    if (v < 0 || u + v > 1) continue;
    const s = (e2x * qx + e2y * qy + e2z * qz) / det;
    if (s <= 0 || s >= nearest) continue;
    const height = (o[0] + s * d[0]) * view.up[0] + (o[1] + s * d[1]) * view.up[1] + (o[2] + s * d[2]) * view.up[2];
    if (height > view.cut) continue;
    nearest = s;
    triangle = t;
  }
  if (triangle < 0) return null;
  const point = add(o, scaled(d, nearest));
  const corners = [0, 1, 2].map(function (k) { return pointOf(surface, ids[triangle + k]); });
  corners.sort(function (a, b) { return distance(a, point) - distance(b, point); });
  return { point: point, vertex: corners[0], along: nearest };
}

function pointOf(surface, i) {
  return [surface.positions[3 * i], surface.positions[3 * i + 1], surface.positions[3 * i + 2]];
}

// The nearest point of a cloud within some pixels of a ray.
function hitCloud(surface, ray, lens, view) {
  const REACH_PX = 6;
  let best = null;
  for (let i = 0; i < surface.count; i++) {
    const point = pointOf(surface, i);
    const offset = subtract(point, ray.origin);
    const along = dot(offset, ray.direction);
    if (along <= 0 || best && along >= best.along || dot(point, view.up) > view.cut) continue;
    const aside = length(subtract(offset, scaled(ray.direction, along)));
    if (aside > REACH_PX * pixelLength(lens, along)) continue;
    if (view.looksInside && surface.hasNormals) {
      const n = [surface.normals[4 * i], surface.normals[4 * i + 1], surface.normals[4 * i + 2]];
      if (dot(n, ray.direction) > 0) continue;
    }
    best = { point: point, vertex: point, along: along };
  }
  return best;
}
