// Programs of the graphics processor, in the language of WebGL 1, which WebGL 2 runs as well.

// The light sits at the camera. `light` is the share that a surface seen edge-on loses.
const SURFACE_VERTEX = `
attribute vec3 position;
attribute vec3 normal;
attribute vec3 color;
uniform mat4 clipFromWorld;
uniform vec3 eye;
uniform vec3 forward;
uniform float isParallel;
uniform float light;
uniform float pointPixels;
uniform float cullsPoints;
uniform vec3 up;
varying vec3 shade;
varying float height;
void main() {
  vec4 place = clipFromWorld * vec4(position, 1.0);
  vec3 towards = mix(normalize(eye - position), -forward, isParallel);
  float hasNormal = step(0.01, dot(normal, normal));
  float facing = dot(normal, towards) / max(length(normal), 0.01);
  float lit = mix(1.0, 1.0 - light * (1.0 - abs(facing)), hasNormal);
  shade = color * lit;
  height = dot(up, position);
  gl_PointSize = clamp(pointPixels / max(mix(place.w, 1.0, isParallel), 1e-6), 1.5, 64.0);
  if (cullsPoints * hasNormal > 0.5 && facing < 0.0) place = vec4(0.0, 0.0, 2.0, 1.0);
  gl_Position = place;
}`;

const SURFACE_FRAGMENT = `
precision mediump float;
varying vec3 shade;
varying highp float height;
uniform highp float cut;
uniform float isPoint;
void main() {
  if (height > cut) discard;
  if (isPoint > 0.5 && distance(gl_PointCoord, vec2(0.5)) > 0.5) discard;
  // A surface seen from behind is greyer and darker.
  vec3 back = vec3(0.45 * dot(shade, vec3(0.299, 0.587, 0.114)) + 0.08);
  gl_FragColor = vec4(isPoint > 0.5 || gl_FrontFacing ? shade : back, 1.0);
}`;

// Lines as ribbons of constant width on the screen: WebGL's own are one pixel wide.
const LINE_VERTEX = `
attribute vec3 from;
attribute vec3 to;
attribute vec2 corner;
attribute vec4 color;
uniform mat4 clipFromWorld;
uniform vec2 viewport;
uniform float width;
uniform float near;
varying vec4 shade;
void main() {
  vec4 a = clipFromWorld * vec4(from, 1.0);
  vec4 b = clipFromWorld * vec4(to, 1.0);
  shade = color;
  if (a.w < near && b.w < near) { gl_Position = vec4(0.0, 0.0, 2.0, 1.0); return; }
  if (a.w < near) a = mix(a, b, (near - a.w) / (b.w - a.w));
  if (b.w < near) b = mix(b, a, (near - b.w) / (a.w - b.w));
  vec2 along = (b.xy / b.w - a.xy / a.w) * viewport;
  along = length(along) > 1e-6 ? normalize(along) : vec2(1.0, 0.0);
  vec4 end = corner.x < 0.5 ? a : b;
  // Half a width further at both ends, so that bends have no gaps.
  vec2 offset = vec2(-along.y, along.x) * corner.y + along * (2.0 * corner.x - 1.0);
  end.xy += offset * width / viewport * end.w;
  gl_Position = end;
}`;

const LINE_FRAGMENT = `
precision mediump float;
varying vec4 shade;
uniform float opacity;
void main() {
  gl_FragColor = vec4(shade.rgb * shade.a * opacity, shade.a * opacity);
}`;

function programOf(gl, vertex, fragment) {
  const program = gl.createProgram();
  [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]].forEach(function (part) {
    const shader = gl.createShader(part[0]);
    gl.shaderSource(shader, part[1]);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  });
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) {
    throw new Error("the graphics processor refuses a program: " + gl.getProgramInfoLog(program));
  }
  const found = { program: program, attribute: {}, uniform: {} };
  const attributes = gl.getProgramParameter(program, gl.ACTIVE_ATTRIBUTES);
  for (let i = 0; i < attributes; i++) {
    const name = gl.getActiveAttrib(program, i).name;
    found.attribute[name] = gl.getAttribLocation(program, name);
  }
  const uniforms = gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS);
  for (let i = 0; i < uniforms; i++) {
    const name = gl.getActiveUniform(program, i).name;
    found.uniform[name] = gl.getUniformLocation(program, name);
  }
  return found;
}

// An array that stays enabled would be read by the next program, too, which may have none in its place.
function releaseAttributes(gl, program) {
  Object.keys(program.attribute).forEach(function (name) { gl.disableVertexAttribArray(program.attribute[name]); });
}
