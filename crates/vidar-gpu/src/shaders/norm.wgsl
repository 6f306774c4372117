// Layer norm over rows, by vectors of four: eight invocations a row, eight rows a workgroup.
struct Params {
  rows: u32,
  width: u32, // all of these by four
  in_at: u32,
  in_stride: u32,
  out_at: u32,
  out_stride: u32,
  eps: f32,
}
var<immediate> p: Params;
@group(0) @binding(0) var<storage, read> x: array<vec4<f32>>;
@group(0) @binding(1) var<storage, read> weight: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> bias: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> y: array<vec4<f32>>;

var<workgroup> parts: array<f32, 64>;

fn over_row(i: u32, own: f32) -> f32 {
  parts[i] = own;
  workgroupBarrier();
  var total = 0.0;
  for (var j = 0u; j < 8u; j++) {
    total += parts[(i & 56u) + j];
  }
  workgroupBarrier();
  return total;
}

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) i: u32) {
  let wanted = (group.x + group.y * 32768u) * 8u + i / 8u;
  let row = min(wanted, p.rows - 1u);
  let start = p.in_at + row * p.in_stride;
  var sum = vec4<f32>();
  for (var c = i % 8u; c < p.width; c += 8u) {
    sum += x[start + c];
  }
  let count = f32(p.width * 4u);
  let mean = over_row(i, sum.x + sum.y + sum.z + sum.w) / count;
  var square = vec4<f32>();
  for (var c = i % 8u; c < p.width; c += 8u) {
    let d = x[start + c] - mean;
    square = fma(d, d, square);
  }
  let variance = over_row(i, square.x + square.y + square.z + square.w) / count;
  let scale = 1.0 / sqrt(variance + p.eps);
  if wanted >= p.rows { return; }
  let to = p.out_at + row * p.out_stride;
  for (var c = i % 8u; c < p.width; c += 8u) {
    y[to + c] = fma((x[start + c] - mean) * scale, weight[c], bias[c]);
  }
}
