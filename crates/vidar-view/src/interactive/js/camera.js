// Where the reader looks from: round a point, walking, or along the path of the camera.

// Half of the height of the picture at distance 1: 50 degrees from top to bottom.
const HALF_HEIGHT = Math.tan(25 * Math.PI / 180);
// Straight up or down, "right" is not defined by "up".
const MOST_PITCH = 89.5 * Math.PI / 180;

// Two horizontal directions and up.
function basisOf(up) {
  const away = unit(cross(up, Math.abs(up[0]) < 0.9 ? [1, 0, 0] : [0, -1, 0]));
  return { right: unit(cross(away, up)), away: away, up: up };
}

// bounds: center, radius, half extents along right, away and up, and some places of the map with normals.
function Camera(basis, bounds) {
  this.basis = basis;
  this.bounds = bounds;
  this.isParallel = false;
  this.home();
}

Camera.prototype.home = function () {
  this.mode = "orbit";
  // Along the shorter side, so that the longer one lies across the picture.
  const isWide = this.bounds.half[0] >= this.bounds.half[1];
  this.yaw = isWide ? 0.5 : 0.5 + Math.PI / 2;
  this.pitch = -0.75;
  this.pose = null;
  this.fit();
  // Until the reader moves, the map goes on filling a window that changes.
  this.isWhole = true;
  this.halfHeight = HALF_HEIGHT;
};

Camera.prototype.fromAbove = function () {
  this.home();
  this.yaw = 0;
  this.pitch = -MOST_PITCH;
  this.fit();
};

// Pivot and distance with which the map fills the picture: what faces the camera, but for the outermost half percent.
Camera.prototype.fit = function () {
  const aspect = this.aspect || 1.5;
  const forward = this.forward();
  const right = unit(cross(forward, this.basis.up));
  const up = cross(right, forward);
  const center = this.bounds.center;
  const seen = this.bounds.samples.filter(function (s) { return !s.normal || dot(s.normal, forward) < 0; });
  const offsets = (seen.length ? seen : this.bounds.samples).map(function (s) {
    const offset = subtract(s.place, center);
    return [dot(offset, right), dot(offset, up), dot(offset, forward)];
  });
  const ends = function (values) {
    values.sort(function (a, b) { return a - b; });
    const trim = Math.floor(values.length / 200);
    return [values[trim], values[values.length - 1 - trim]];
  };
  let shift = [0, 0];
  this.distance = this.bounds.radius;
  // The middle of the picture depends on the distance and the distance on the middle; four rounds settle both to a percent.
  for (let round = 0; round < 4; round++) {
    this.distance = Math.max(ends(offsets.map(function (o) {
      const across = Math.max(Math.abs(o[0] - shift[0]) / aspect, Math.abs(o[1] - shift[1]));
      return across / HALF_HEIGHT - o[2];
    }))[1], 0.1 * this.bounds.radius);
    const d = this.distance;
    [0, 1].forEach(function (k) {
      const e = ends(offsets.map(function (o) { return (o[k] - shift[k]) / Math.max(d + o[2], 0.1 * d); }));
      shift[k] += d * (e[0] + e[1]) / 2;
    });
  }
  this.pivot = add(center, add(scaled(right, shift[0]), scaled(up, shift[1])));
  // A margin for names and scales.
  this.distance *= 1.1;
};

Camera.prototype.forward = function () {
  const b = this.basis;
  const flat = add(scaled(b.right, Math.sin(this.yaw)), scaled(b.away, Math.cos(this.yaw)));
  return add(scaled(flat, Math.cos(this.pitch)), scaled(b.up, Math.sin(this.pitch)));
};

// Eye and unit directions in the world.
Camera.prototype.frame = function () {
  if (this.mode === "path" && this.pose) {
    const q = this.pose.rotation;
    return {
      eye: this.pose.position,
      right: turned(q, [1, 0, 0]),
      up: turned(q, [0, -1, 0]),
      forward: turned(q, [0, 0, 1]),
    };
  }
  const forward = this.forward();
  const right = unit(cross(forward, this.basis.up));
  const eye = this.mode === "walk" ? this.eye : subtract(this.pivot, scaled(forward, this.distance));
  return { eye: eye, right: right, up: cross(right, forward), forward: forward };
};

// Matrices and lengths for a picture of width x height pixels.
Camera.prototype.lens = function (width, height) {
  const aspect = width / height;
  if (aspect !== this.aspect) {
    this.aspect = aspect;
    if (this.isWhole) this.fit();
  }
  const frame = this.frame();
  const isParallel = this.isParallel && this.mode === "orbit";
  const reach = distance(frame.eye, this.bounds.center) + 2 * this.bounds.radius;
  const near = isParallel ? -reach : Math.max(this.bounds.radius / 2000, this.mode === "orbit" ? this.distance / 200 : 0);
  const halfHeight = isParallel ? this.halfHeight * this.distance : this.halfHeight;
  const project = isParallel ? parallel : perspective;
  const view = cameraFromWorld(frame);
  return {
    frame: frame,
    width: width,
    height: height,
    aspect: aspect,
    halfHeight: halfHeight,
    isParallel: isParallel,
    near: near,
    view: view,
    clipFromWorld: product(project(halfHeight, aspect, near, reach), view),
  };
};

// Length of a pixel at a distance along the view.
function pixelLength(lens, depth) {
  return 2 * lens.halfHeight * (lens.isParallel ? 1 : depth) / lens.height;
}

// Pixel of a point, from the top left corner of the picture, and its distance along the view; null behind the eye.
function pixelOf(lens, point) {
  const clip = mapped(lens.clipFromWorld, point);
  const depth = dot(subtract(point, lens.frame.eye), lens.frame.forward);
  if (!lens.isParallel && depth < lens.near) return null;
  return {
    x: (clip[0] / clip[3] + 1) / 2 * lens.width,
    y: (1 - clip[1] / clip[3]) / 2 * lens.height,
    depth: depth,
  };
}

// The ray through a pixel.
function rayOf(lens, x, y) {
  const f = lens.frame;
  const sideways = (2 * x / lens.width - 1) * lens.halfHeight * lens.aspect;
  const upwards = (1 - 2 * y / lens.height) * lens.halfHeight;
  const offset = add(scaled(f.right, sideways), scaled(f.up, upwards));
  if (lens.isParallel) {
    return { origin: add(add(f.eye, offset), scaled(f.forward, lens.near)), direction: f.forward };
  }
  return { origin: f.eye, direction: unit(add(f.forward, offset)) };
}

// Turns by pixels of a drag; the surface follows the pointer.
Camera.prototype.turn = function (dx, dy, height) {
  this.leavePath();
  const rate = this.mode === "walk" ? -2 * this.halfHeight / height : Math.PI / height;
  this.yaw += rate * dx;
  this.pitch = clamped(this.pitch - rate * dy, -MOST_PITCH, MOST_PITCH);
};

// Moves sideways and upwards by pixels.
Camera.prototype.shift = function (dx, dy, height) {
  this.leavePath();
  const f = this.frame();
  const rate = 2 * this.halfHeight * this.distance / height;
  const step = add(scaled(f.right, -dx * rate), scaled(f.up, dy * rate));
  this.pivot = add(this.pivot, step);
  if (this.mode === "walk") this.eye = add(this.eye, step);
};

// Nearer for positive steps; walking goes ahead.
Camera.prototype.zoom = function (steps) {
  this.leavePath();
  if (this.mode === "walk") {
    this.go([0, steps * 0.03 * this.bounds.radius, 0]);
  } else {
    this.distance = clamped(this.distance * Math.exp(-0.15 * steps), this.bounds.radius / 500, this.bounds.radius * 20);
  }
};

// Walks: metres to the right, ahead and up. Walking ahead stays level, as one does in a room.
Camera.prototype.go = function (step) {
  this.leavePath();
  const f = this.frame();
  const ahead = unit(cross(this.basis.up, f.right));
  const move = add(add(scaled(f.right, step[0]), scaled(ahead, step[1])), scaled(this.basis.up, step[2]));
  if (this.mode === "walk") this.eye = add(this.eye, move);
  this.pivot = add(this.pivot, move);
};

Camera.prototype.look = function (frame, mode) {
  const forward = frame.forward;
  this.pitch = clamped(Math.asin(clamped(dot(forward, this.basis.up), -1, 1)), -MOST_PITCH, MOST_PITCH);
  this.yaw = Math.atan2(dot(forward, this.basis.right), dot(forward, this.basis.away));
  this.mode = mode;
  this.pose = null;
  this.isWhole = false;
  if (mode === "walk") {
    this.eye = frame.eye.slice();
    this.distance = 0.3 * this.bounds.radius;
    this.pivot = add(this.eye, scaled(forward, this.distance));
  }
};

// A drag on the path goes on as walking from there.
Camera.prototype.leavePath = function () {
  this.isWhole = false;
  if (this.mode === "path") this.look(this.frame(), "walk");
};

Camera.prototype.setMode = function (mode) {
  if (mode === this.mode) return;
  if (mode === "walk") {
    this.look(this.frame(), "walk");
  } else if (mode === "orbit") {
    // Round what is in front would often be round a wall: the whole map is what one comes back for.
    this.home();
  } else {
    this.mode = "path";
  }
  if (mode !== "path") this.halfHeight = HALF_HEIGHT;
};

// Turns about a point from where the camera is.
Camera.prototype.turnAbout = function (point) {
  this.leavePath();
  const eye = this.frame().eye;
  const forward = unit(subtract(point, eye));
  this.look({ eye: eye, forward: forward }, "orbit");
  this.pivot = point;
  this.distance = Math.max(distance(point, eye), this.bounds.radius / 500);
};

Camera.prototype.copy = function (other) {
  const same = ["mode", "yaw", "pitch", "distance", "isParallel", "isWhole", "halfHeight", "pose"];
  same.forEach(function (key) { this[key] = other[key]; }, this);
  this.pivot = other.pivot.slice();
  this.eye = other.eye ? other.eye.slice() : other.eye;
};

// The pose on a path at a time in seconds.
function poseAt(path, time) {
  const poses = path.poses;
  if (poses.length === 0) return null;
  let after = poses.findIndex(function (p) { return p.time >= time; });
  if (after < 0) after = poses.length - 1;
  const a = poses[Math.max(0, after - 1)];
  const b = poses[after];
  const share = b.time > a.time ? clamped((time - a.time) / (b.time - a.time), 0, 1) : 0;
  return {
    position: mixed(a.position, b.position, share),
    rotation: slerp(a.rotation, b.rotation, share),
  };
}
