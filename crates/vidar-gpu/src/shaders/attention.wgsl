// Attention block by block (the running maximum and sum of a softmax): one invocation a query of a head; keys and values pass
// through workgroup memory, {{KEYS}} at a time.
struct Params {
  queries: u32,  // of a sequence
  q_first: u32,  // token of the first
  keys: u32,     // of a sequence
  k_first: u32,
  heads: u32,
  out_first: u32,
  factor: f32,   // 1 / √channels · log₂ e
}
var<immediate> p: Params;
@group(0) @binding(0) var<storage, read> qkv: array<vec4<f32>>; // [tokens][3][heads][D]
@group(0) @binding(1) var<storage, read_write> y: array<vec4<f32>>; // [tokens][heads][D]

const D = {{D}}u;
const KEYS = {{KEYS}}u;
var<workgroup> ks: array<vec4<f32>, {{WORDS}}>;
var<workgroup> vs: array<vec4<f32>, {{WORDS}}>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) i: u32) {
  let head = group.y;
  let wanted = group.x * 64u + i;
  let query = group.z * p.queries + min(wanted, p.queries - 1u);
  let first = p.k_first + group.z * p.keys;
  let start = ((p.q_first + query) * 3u * p.heads + head) * D;
{{QUERY}}
  var top = -3.0e38;
  var total = 0.0;
  for (var block = 0u; block < p.keys; block += KEYS) {
    workgroupBarrier();
    for (var e = i; e < KEYS * D; e += 64u) {
      let key = first + min(block + e / D, p.keys - 1u);
      let at = ((key * 3u + 1u) * p.heads + head) * D + e % D;
      ks[e] = qkv[at];
      vs[e] = qkv[at + p.heads * D];
    }
    workgroupBarrier();
    for (var b = 0u; b < KEYS; b += 8u) {
{{SCORES}}
      let highest = {{HIGHEST}};
      if highest > top {
        let shrink = exp2(top - highest);
        top = highest;
        total *= shrink;
{{SHRINK}}
      }
{{ADD}}
    }
  }
  if wanted >= p.queries { return; }
  let to = ((p.out_first + query) * p.heads + head) * D;
  let share = 1.0 / total;
{{STORE}}
}
