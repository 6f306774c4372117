// Vectors are arrays of three numbers. Matrices are arrays of sixteen, column by column, as WebGL takes them.

function add(a, b) { return [a[0] + b[0], a[1] + b[1], a[2] + b[2]]; }
function subtract(a, b) { return [a[0] - b[0], a[1] - b[1], a[2] - b[2]]; }
function scaled(a, s) { return [a[0] * s, a[1] * s, a[2] * s]; }
function dot(a, b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
function cross(a, b) {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}
function length(a) { return Math.sqrt(dot(a, a)); }
function distance(a, b) { return length(subtract(a, b)); }
function unit(a) {
  const n = length(a);
  return n > 0 ? scaled(a, 1 / n) : [0, 0, 1];
}
function mixed(a, b, t) { return [0, 1, 2].map(function (i) { return a[i] + (b[i] - a[i]) * t; }); }
function clamped(v, low, high) { return Math.min(Math.max(v, low), high); }

// The vector v turned by the unit quaternion q = [x, y, z, w].
function turned(q, v) {
  const axis = [q[0], q[1], q[2]];
  const t = scaled(cross(axis, v), 2);
  return add(v, add(scaled(t, q[3]), cross(axis, t)));
}

// Between two unit quaternions, the shorter way round.
function slerp(p, q, t) {
  let cosine = p[0] * q[0] + p[1] * q[1] + p[2] * q[2] + p[3] * q[3];
  const sign = cosine < 0 ? -1 : 1;
  cosine = Math.min(1, Math.abs(cosine));
  const angle = Math.acos(cosine);
  // Below this angle the two weights are those of a straight line to within rounding.
  const straight = angle < 1e-4;
  const a = straight ? 1 - t : Math.sin((1 - t) * angle) / Math.sin(angle);
  const b = sign * (straight ? t : Math.sin(t * angle) / Math.sin(angle));
  return [0, 1, 2, 3].map(function (i) { return a * p[i] + b * q[i]; });
}

function product(a, b) {
  const out = new Array(16).fill(0);
  for (let column = 0; column < 4; column++) {
    for (let row = 0; row < 4; row++) {
      for (let k = 0; k < 4; k++) {
        out[4 * column + row] += a[4 * k + row] * b[4 * column + k];
      }
    }
  }
  return out;
}

// m times the point p, with its fourth coordinate.
function mapped(m, p) {
  const row = function (i) { return m[i] * p[0] + m[4 + i] * p[1] + m[8 + i] * p[2] + m[12 + i]; };
  return [row(0), row(1), row(2), row(3)];
}

// frame: eye, right, up, forward in the world. Camera axes are OpenGL's: x right, y up, z backwards.
function cameraFromWorld(frame) {
  const r = frame.right;
  const u = frame.up;
  const b = scaled(frame.forward, -1);
  return [
    r[0], u[0], b[0], 0,
    r[1], u[1], b[1], 0,
    r[2], u[2], b[2], 0,
    -dot(r, frame.eye), -dot(u, frame.eye), -dot(b, frame.eye), 1,
  ];
}

// halfHeight: half of the height of the picture at distance 1.
function perspective(halfHeight, aspect, near, far) {
  const f = 1 / halfHeight;
  return [
    f / aspect, 0, 0, 0,
    0, f, 0, 0,
    0, 0, (far + near) / (near - far), -1,
    0, 0, 2 * far * near / (near - far), 0,
  ];
}

// halfHeight: half of the height of the picture, in the unit of the world.
function parallel(halfHeight, aspect, near, far) {
  return [
    1 / (halfHeight * aspect), 0, 0, 0,
    0, 1 / halfHeight, 0, 0,
    0, 0, 2 / (near - far), 0,
    0, 0, (far + near) / (near - far), 1,
  ];
}
