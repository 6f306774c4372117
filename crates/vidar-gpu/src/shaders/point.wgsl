// The end of a head, pixel by pixel: norm (where there is one), max(x, 0), a 1×1 layer from 32 channels, an activation by
// channel. The output has its channels as planes.
struct Params {
  pixels: u32,
  outputs: u32,
  out_at: u32,
  activations: u32, // four bits a channel
  eps: f32,
}
var<immediate> p: Params;
@group(0) @binding(0) var<storage, read> x: array<vec4<f32>>;
@group(0) @binding(1) var<storage, read> norm_weight: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> norm_bias: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> w: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read> bias: array<f32>;
@group(0) @binding(5) var<storage, read_write> y: array<f32>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) i: u32) {
  let pixel = (group.x + group.y * 32768u) * 64u + i;
  if pixel >= p.pixels { return; }
  var v: array<vec4<f32>, 8>;
  var sum = vec4<f32>();
  for (var c = 0u; c < 8u; c++) {
    v[c] = x[pixel * 8u + c];
    sum += v[c];
  }
{{NORM}}
  for (var c = 0u; c < 8u; c++) {
    v[c] = max(v[c], vec4<f32>());
  }
  for (var o = 0u; o < p.outputs; o++) {
    var s = bias[o];
    for (var c = 0u; c < 8u; c++) {
      s += dot(v[c], w[o * 8u + c]);
    }
    switch (p.activations >> (4u * o)) & 15u {
      case 1u: { s = exp(s); }
      case 2u: { s = 1.0 + exp(s); }
      case 3u: { s = max(s, 0.0); }
      default: {}
    }
    y[p.out_at + o * p.pixels + pixel] = s;
  }
}
