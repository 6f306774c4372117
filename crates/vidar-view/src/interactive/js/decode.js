// Unpacks what payload.rs packs.

const NO_VALUE = 255;

function bytesOf(base64) {
  const text = atob(base64);
  const out = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) out[i] = text.charCodeAt(i);
  return out;
}

// Positions as metres. They stay in doubles for measuring; the graphics processor gets floats.
function positionsOf(packed, count) {
  const bytes = bytesOf(packed.steps);
  const out = new Float64Array(3 * count);
  for (let i = 0; i < 3 * count; i++) {
    const steps = bytes[2 * i] + 256 * bytes[2 * i + 1];
    out[i] = packed.lower[i % 3] + packed.step[i % 3] * steps;
  }
  return out;
}

// Octahedral normals as three signed bytes; none is (0, 0, 0).
function normalsOf(packed, count) {
  const out = new Int8Array(4 * count);
  if (!packed) return out;
  const bytes = bytesOf(packed);
  for (let i = 0; i < count; i++) {
    if (bytes[2 * i] === 0 && bytes[2 * i + 1] === 0) continue;
    let x = (bytes[2 * i] - 128) / 127;
    let y = (bytes[2 * i + 1] - 128) / 127;
    const z = 1 - Math.abs(x) - Math.abs(y);
    if (z < 0) {
      const fold = x;
      x = (1 - Math.abs(y)) * (x < 0 ? -1 : 1);
      y = (1 - Math.abs(fold)) * (y < 0 ? -1 : 1);
    }
    const n = unit([x, y, z]);
    for (let axis = 0; axis < 3; axis++) out[4 * i + axis] = Math.round(127 * n[axis]);
  }
  return out;
}

// Distances to the next new index, seven bits a byte.
function indicesOf(packed, count) {
  const bytes = bytesOf(packed);
  const out = new Uint32Array(count);
  let at = 0;
  let next = 0;
  for (let i = 0; i < count; i++) {
    let code = 0;
    let factor = 1;
    while (bytes[at] >= 128) {
      code += (bytes[at++] - 128) * factor;
      factor *= 128;
    }
    code += bytes[at++] * factor;
    out[i] = next - code;
    if (code === 0) next++;
  }
  return out;
}

function surfaceOf(packed) {
  if (!packed) return null;
  const count = packed.vertices;
  return {
    count: count,
    positions: positionsOf(packed.positions, count),
    step: packed.positions.step,
    normals: normalsOf(packed.normals, count),
    hasNormals: packed.normals !== null,
    colors: packed.colors ? bytesOf(packed.colors) : null,
    values: packed.values.map(function (v) { return v ? bytesOf(v) : null; }),
    indices: packed.indices ? indicesOf(packed.indices, 3 * packed.triangles) : null,
    spacing: packed.spacing || 0,
  };
}

// Poses: time in seconds after the first, position, quaternion.
function pathOf(packed) {
  const bytes = bytesOf(packed.poses);
  const numbers = new Float32Array(bytes.buffer, 0, bytes.length / 4);
  const poses = [];
  for (let i = 0; i + 8 <= numbers.length; i += 8) {
    poses.push({
      time: numbers[i],
      position: [numbers[i + 1], numbers[i + 2], numbers[i + 3]],
      rotation: [numbers[i + 4], numbers[i + 5], numbers[i + 6], numbers[i + 7]],
    });
  }
  return { name: packed.name, role: packed.role, poses: poses };
}

// Corners of the image of a keyframe at z-depth `reach`, in the world: top left, top right, bottom right, bottom left.
function cornersOf(keyframe, reach) {
  const e = keyframe.edges;
  return [[e[0], e[1]], [e[2], e[1]], [e[2], e[3]], [e[0], e[3]]].map(function (xy) {
    return add(keyframe.position, turned(keyframe.rotation, [xy[0] * reach, xy[1] * reach, reach]));
  });
}

function paneOf(packed) {
  return {
    name: packed.name,
    isMetric: packed.isMetric,
    isReference: packed.isReference,
    scaleLogStd: packed.scaleLogStd,
    fields: packed.fields,
    mesh: surfaceOf(packed.mesh),
    cloud: surfaceOf(packed.cloud),
    paths: packed.paths.map(pathOf),
    keyframes: packed.keyframes,
  };
}
