// Norm and rotation of queries and keys in place: one invocation a head of a token.
struct Params {
  items: u32,     // tokens · 2 · heads
  heads: u32,
  positions: u32, // rows of the rotation tables
  q_eps: f32,
  k_eps: f32,
}
var<immediate> p: Params;
@group(0) @binding(0) var<storage, read> q_weight: array<vec4<f32>>;
@group(0) @binding(1) var<storage, read> q_bias: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> k_weight: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> k_bias: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read> turns: array<vec4<f32>>; // [positions][cosines | sines of both halves]
@group(0) @binding(5) var<storage, read_write> qkv: array<vec4<f32>>;

const D = {{D}}u; // channels of a head by four

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) i: u32) {
  let item = (group.x + group.y * 32768u) * 64u + i;
  if item >= p.items { return; }
  let head = item % p.heads;
  let is_key = item / p.heads % 2u == 1u;
  let token = item / p.heads / 2u;
  let at = ((token * 3u + u32(is_key)) * p.heads + head) * D;
{{LOAD}}
{{NORM}}
{{TURN}}
{{STORE}}
}
