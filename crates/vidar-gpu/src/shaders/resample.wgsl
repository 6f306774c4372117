// Bilinear enlargement with the corner pixels' centres kept, and an embedding of columns and rows where there is one.
struct Params {
  count: u32,        // vectors of four to be made
  channels: u32,     // by four
  in_rows: u32,
  in_columns: u32,
  out_columns: u32,
  row_step: f32,     // input rows from output row to output row
  column_step: f32,
}
var<immediate> p: Params;
@group(0) @binding(0) var<storage, read> x: array<vec4<f32>>;
@group(0) @binding(1) var<storage, read> by_column: array<{{TABLE}}>;
@group(0) @binding(2) var<storage, read> by_row: array<{{TABLE}}>;
@group(0) @binding(3) var<storage, read_write> y: array<vec4<f32>>;

fn pixel(row: u32, column: u32, c: u32) -> vec4<f32> {
  return x[(row * p.in_columns + column) * p.channels + c];
}

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) i: u32) {
  let at = (group.x + group.y * 32768u) * 256u + i;
  if at >= p.count { return; }
  let c = at % p.channels;
  let column = at / p.channels % p.out_columns;
  let row = at / p.channels / p.out_columns;
  let v = f32(row) * p.row_step;
  let u = f32(column) * p.column_step;
  let r0 = min(u32(v), p.in_rows - 1u);
  let c0 = min(u32(u), p.in_columns - 1u);
  let r1 = min(r0 + 1u, p.in_rows - 1u);
  let c1 = min(c0 + 1u, p.in_columns - 1u);
  let tv = v - f32(r0);
  let tu = u - f32(c0);
  let upper = mix(pixel(r0, c0, c), pixel(r0, c1, c), tu);
  let lower = mix(pixel(r1, c0, c), pixel(r1, c1, c), tu);
  y[at] = mix(upper, lower, tv){{EMBED}};
}
{{FUNCTION}}
