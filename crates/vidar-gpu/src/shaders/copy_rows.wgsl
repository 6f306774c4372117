// Rows of one buffer become rows of another.
struct Params {
  count: u32, // numbers
  width: u32,
  in_at: u32,
  in_stride: u32,
  out_at: u32,
  out_stride: u32,
}
var<immediate> p: Params;
@group(0) @binding(0) var<storage, read> x: array<f32>;
@group(0) @binding(1) var<storage, read_write> y: array<f32>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) i: u32) {
  let at = (group.x + group.y * 32768u) * 256u + i;
  if at < p.count {
    let row = at / p.width;
    y[p.out_at + row * p.out_stride + at % p.width] = x[p.in_at + row * p.in_stride + at % p.width];
  }
}
