//! Naive references in f64 and deterministic numbers.
#![allow(dead_code, clippy::unwrap_used)] // each test binary uses its own part; tests may stop at the first surprise

use vidar_nn::{Compute, Isa, Precision, Weight};

/// SplitMix64 as a stream of numbers in [-1, 1): that of `vidar_core::random`, which this crate cannot see, as it depends on no
/// other of the workspace.
pub struct Numbers(pub u64);

impl Numbers {
    pub fn next(&mut self) -> f32 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut x = self.0;
        x = (x ^ (x >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        x = (x ^ (x >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        x ^= x >> 31;
        (x >> 40) as f32 / (1 << 23) as f32 - 1.0
    }
    pub fn vec(&mut self, n: usize) -> Vec<f32> {
        (0..n).map(|_| self.next()).collect()
    }
    pub fn weight(&mut self, shape: &[usize]) -> Weight {
        Weight::owned("w", shape, self.vec(shape.iter().product()))
    }
}

/// Every kernel set of this machine with every precision.
pub fn all_computes() -> Vec<Compute> {
    let mut all = Vec::new();
    for isa in Isa::available() {
        for precision in Precision::ALL {
            all.push(Compute::with_isa(isa, precision).unwrap());
        }
    }
    all
}

/// Every kernel set in f32.
pub fn f32_computes() -> Vec<Compute> {
    Isa::available().into_iter().map(|isa| Compute::with_isa(isa, Precision::F32).unwrap()).collect()
}

/// Largest |a - b| over the root mean square of b.
pub fn error_in_std(a: &[f32], b: &[f64]) -> f64 {
    assert_eq!(a.len(), b.len());
    if b.is_empty() {
        return 0.0;
    }
    let rms = (b.iter().map(|x| x * x).sum::<f64>() / b.len() as f64).sqrt().max(1e-3);
    let errors = a.iter().zip(b).map(|(a, b)| (f64::from(*a) - b).abs());
    errors.fold(0.0, |m, x| if x > m || x.is_nan() { x } else { m }) / rms
}

/// What each precision must hold for one matrix product, in standard deviations of the output: the bound on the largest
/// error of some thousand outputs (four to five times the typical one).
pub fn bound(precision: Precision) -> f64 {
    match precision {
        Precision::F32 => 3e-6,
        Precision::F16 => 3e-3,
        Precision::Bf16 => 2e-2,
    }
}

pub fn wide(x: &[f32]) -> Vec<f64> {
    x.iter().map(|x| f64::from(*x)).collect()
}

pub fn linear(x: &[f32], w: &[f32], b: Option<&[f32]>, rows: usize, inner: usize, width: usize) -> Vec<f64> {
    let mut out = vec![0.0; rows * width];
    for r in 0..rows {
        for o in 0..width {
            let mut sum = b.map_or(0.0, |b| f64::from(b[o]));
            for k in 0..inner {
                sum += f64::from(x[r * inner + k]) * f64::from(w[o * inner + k]);
            }
            out[r * width + o] = sum;
        }
    }
    out
}

pub struct Conv {
    pub h: usize,
    pub w: usize,
    pub inputs: usize,
    pub outputs: usize,
    pub kernel: [usize; 2],
    pub stride: usize,
    pub padding: usize,
}

pub fn conv(
    p: &Conv,
    x: &[f32],
    weight: &[f32],
    bias: Option<&[f32]>,
    relu: bool,
) -> (Vec<f64>, usize, usize) {
    let [kh, kw] = p.kernel;
    let oh = (p.h + 2 * p.padding - kh) / p.stride + 1;
    let ow = (p.w + 2 * p.padding - kw) / p.stride + 1;
    let mut out = vec![0.0; oh * ow * p.outputs];
    for oy in 0..oh {
        for ox in 0..ow {
            for o in 0..p.outputs {
                let mut sum = bias.map_or(0.0, |b| f64::from(b[o]));
                for ky in 0..kh {
                    for kx in 0..kw {
                        let (y, x0) = (oy * p.stride + ky, ox * p.stride + kx);
                        if y < p.padding || x0 < p.padding || y - p.padding >= p.h || x0 - p.padding >= p.w {
                            continue;
                        }
                        let pixel = ((y - p.padding) * p.w + x0 - p.padding) * p.inputs;
                        for i in 0..p.inputs {
                            let v = x[pixel + i];
                            let v = if relu { v.max(0.0) } else { v };
                            let at = ((o * p.inputs + i) * kh + ky) * kw + kx;
                            sum += f64::from(v) * f64::from(weight[at]);
                        }
                    }
                }
                out[(oy * ow + ox) * p.outputs + o] = sum;
            }
        }
    }
    (out, oh, ow)
}

/// erf by its series and continued fraction, to 1e-14 or so.
pub fn erf(x: f64) -> f64 {
    let a = x.abs();
    let value = if a < 3.0 {
        let (mut term, mut sum, mut n) = (a, a, 0.0);
        while term.abs() > 1e-17 * sum.abs() {
            n += 1.0;
            term *= -a * a / n;
            sum += term / (2.0 * n + 1.0);
            if n > 200.0 {
                break;
            }
        }
        sum * 2.0 / std::f64::consts::PI.sqrt()
    } else {
        let mut f = 0.0;
        for k in (1..=60).rev() {
            f = f64::from(k) / 2.0 / (a + f);
        }
        1.0 - (-a * a).exp() / (std::f64::consts::PI.sqrt() * (a + f))
    };
    value.copysign(x)
}

pub fn gelu(x: f64) -> f64 {
    0.5 * x * (1.0 + erf(x / std::f64::consts::SQRT_2))
}

pub fn layer_norm(x: &[f64], weight: &[f32], bias: &[f32], eps: f64) -> Vec<f64> {
    let n = weight.len();
    x.chunks_exact(n)
        .flat_map(|row| {
            let mean = row.iter().sum::<f64>() / n as f64;
            let var = row.iter().map(|x| (x - mean) * (x - mean)).sum::<f64>() / n as f64;
            (0..n)
                .map(|i| (row[i] - mean) / (var + eps).sqrt() * f64::from(weight[i]) + f64::from(bias[i]))
                .collect::<Vec<_>>()
        })
        .collect()
}

/// 2-D rotation of one head, from its definition.
pub fn rope(head: &mut [f64], position: [f32; 2], base: f64) {
    let half = head.len() / 2;
    for (part, p) in head.chunks_exact_mut(half).zip(position) {
        let old = part.to_vec();
        for i in 0..half {
            let j = i % (half / 2);
            let angle = f64::from(p) * base.powf(-2.0 * j as f64 / half as f64);
            let turned = if i < half / 2 { -old[i + half / 2] } else { old[i - half / 2] };
            part[i] = old[i] * angle.cos() + turned * angle.sin();
        }
    }
}

/// Softmax attention of prepared heads: q `[n][d]`, k, v `[m][d]`.
pub fn attend(q: &[f64], k: &[f64], v: &[f64], d: usize) -> Vec<f64> {
    let scale = 1.0 / (d as f64).sqrt();
    q.chunks_exact(d)
        .flat_map(|q| {
            let scores: Vec<f64> =
                k.chunks_exact(d).map(|k| q.iter().zip(k).map(|(a, b)| a * b).sum::<f64>() * scale).collect();
            let top = scores.iter().copied().fold(f64::NEG_INFINITY, f64::max);
            let p: Vec<f64> = scores.iter().map(|s| (s - top).exp()).collect();
            let total: f64 = p.iter().sum();
            let mut out = vec![0.0; d];
            for (p, v) in p.iter().zip(v.chunks_exact(d)) {
                for (o, v) in out.iter_mut().zip(v) {
                    *o += p / total * v;
                }
            }
            out
        })
        .collect()
}
