// An embedding of columns (first half of the channels) and rows (second half) is added to a map.
struct Params {
  count: u32, // vectors of four
  channels: u32,
  out_columns: u32,
}
var<immediate> p: Params;
@group(0) @binding(0) var<storage, read> by_column: array<{{TABLE}}>;
@group(0) @binding(1) var<storage, read> by_row: array<{{TABLE}}>;
@group(0) @binding(2) var<storage, read_write> y: array<vec4<f32>>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) i: u32) {
  let at = (group.x + group.y * 32768u) * 256u + i;
  if at >= p.count { return; }
  let c = at % p.channels;
  let column = at / p.channels % p.out_columns;
  let row = at / p.channels / p.out_columns;
  y[at] += embedding(row, column, c);
}
{{FUNCTION}}
