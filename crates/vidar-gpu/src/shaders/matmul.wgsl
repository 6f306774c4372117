// Y = end(X Wᵀ + b): a workgroup makes a tile of {{BM}} × {{BN}} sums, every invocation {{TM}} × {{TN}} of them, strided so that
// neighbours read neighbouring rows. Both factors lie with the inner index last and are read by four.
struct Params {
  rows: u32,        // of X
  columns: u32,     // of W, sums of a row
  inner: u32,       // inner length / 4
  in_at: u32,       // first number of X / 4
  in_stride: u32,   // numbers from row to row / 4
  out_at: u32,
  out_stride: u32,
  map_rows: u32,    // of the input map, for convolutions
  map_columns: u32,
  out_columns: u32, // of the output map; for spreading, of the input map
  step: u32,        // of a convolution; for spreading, the side
  extra_at: u32,    // first number of what is added
}
var<immediate> p: Params;
@group(0) @binding(0) var<storage, read> x: array<vec4<f32>>;
@group(0) @binding(1) var<storage, read> w: array<{{WTYPE}}>;
@group(0) @binding(2) var<storage, read> bias: array<f32>;
@group(0) @binding(3) var<storage, read> extra: array<f32>;
@group(0) @binding(4) var<storage, read_write> y: array<f32>;

const BM = {{BM}}u;
const BN = {{BN}}u;
const BK = {{BK}}u; // by four
const GX = {{GX}}u; // invocations along the columns
const GY = {{GY}}u;
const STRIDE = BK + 1u; // odd: neighbouring rows begin in other banks
var<workgroup> xs: array<vec4<f32>, {{XS}}>;
var<workgroup> ws: array<vec4<f32>, {{WS}}>;

fn load_x(row: u32, k: u32) -> vec4<f32> {
{{LOAD_X}}
}

fn load_w(column: u32, k: u32) -> vec4<f32> {
  if k >= p.inner { return vec4<f32>(); }
  let at = min(column, p.columns - 1u) * p.inner + k;
{{LOAD_W}}
}

// {{ERF_NOTE}}
fn gelu(v: f32) -> f32 {
  let z = abs(v) * 0.70710678;
  let t = 1.0 / fma(0.3275911, z, 1.0);
  let q = t * fma(t, fma(t, fma(t, fma(t, 1.061405429, -1.453152027), 1.421413741), -0.284496736), 0.254829592);
  let tail = 0.5 * q * exp(-z * z);
  return select(v * (1.0 - tail), v * tail, v < 0.0);
}

fn silu(v: f32) -> f32 {
  return v / (1.0 + exp(-v));
}

fn store(row: u32, column: u32, sum: f32) {
  if row >= p.rows || column >= p.columns { return; }
  let v = sum + bias[column];
{{STORE}}
}

{{STORE_GATED}}

@compute @workgroup_size({{THREADS}})
fn main(@builtin(workgroup_id) tile: vec3<u32>, @builtin(local_invocation_index) i: u32) {
  let first_row = (tile.y + tile.z * 32768u) * BM;
  let first_column = tile.x * BN;
  let tx = i % GX;
  let ty = i / GX;
{{ZERO}}
  let tiles = (p.inner + BK - 1u) / BK;
  for (var t = 0u; t < tiles; t++) {
    for (var e = i; e < BM * BK; e += {{THREADS}}u) {
      xs[(e / BK) * STRIDE + e % BK] = load_x(first_row + e / BK, t * BK + e % BK);
    }
    for (var e = i; e < BN * BK; e += {{THREADS}}u) {
      ws[(e / BK) * STRIDE + e % BK] = load_w(first_column + e / BK, t * BK + e % BK);
    }
    workgroupBarrier();
    for (var k = 0u; k < BK; k++) {
{{PRODUCTS}}
    }
    workgroupBarrier();
  }
{{STORES}}
}
