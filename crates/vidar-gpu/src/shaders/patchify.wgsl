// Patches of side × side pixels of three planes, each as a row [plane][row][column].
struct Params {
  count: u32,   // numbers
  in_at: u32,
  rows: u32,    // of a plane
  columns: u32,
  side: u32,
}
var<immediate> p: Params;
@group(0) @binding(0) var<storage, read> x: array<f32>;
@group(0) @binding(1) var<storage, read_write> y: array<f32>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) i: u32) {
  let at = (group.x + group.y * 32768u) * 256u + i;
  if at >= p.count { return; }
  let area = p.side * p.side;
  let across = p.columns / p.side;
  let patch_index = at / (3u * area);
  let k = at % (3u * area);
  let row = patch_index / across * p.side + k % area / p.side;
  let column = patch_index % across * p.side + k % p.side;
  y[at] = x[p.in_at + (k / area * p.rows + row) * p.columns + column];
}
