//! GFLOP per CPU second of each matrix operation and the share of the peak, for busy machines where wall time says little:
//! `cargo run --release -p vidar-nn --example rates [KERNELS] [PRECISION]`. Linux only (reads `/proc`).
//!
//! The share is of the peak, which is measured first (registers only), or of the best rate so far for kernel sets without
//! a peak loop. `stages` sums the operations of a network up.
#![allow(clippy::print_stdout, clippy::expect_used, reason = "a measuring program")]

mod measure;

use measure::{peak, time};
use vidar_nn::{
    AttentionSpec, Compute, Conv2d, ConvInput, ConvTranspose2d, Corners, Epilogue, HeadBranch, HeadInput,
    LayerNorm, Linear, MapRef, MapSize, Precision, Weight, activation, attention, head, resize_bilinear,
};

fn numbers(n: usize) -> Vec<f32> {
    (0..n).map(|i| ((i * 7919) % 2003) as f32 / 1001.5 - 1.0).collect()
}

fn weight(shape: &[usize]) -> Weight {
    Weight::owned("w", shape, numbers(shape.iter().product()))
}

struct Table {
    only: Option<String>,
    peak: f64,
}

impl Table {
    fn row(&mut self, name: &str, flops: usize, work: impl FnMut()) {
        if self.only.as_ref().is_some_and(|only| !name.contains(only.as_str())) {
            return;
        }
        let (best, median) = time(work);
        let rate = flops as f64 / best;
        self.peak = self.peak.max(rate);
        let share = 100.0 * rate / self.peak;
        println!(
            "{name:36} {:9.3} ms best {:9.3} median {rate:8.1} GF/s {share:4.0} %",
            best / 1e6,
            median / 1e6
        );
    }
}

fn main() {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let precision = words.get(1).map_or(Ok(Precision::F32), |word| word.parse()).expect("a precision");
    let c = match words.first() {
        Some(isa) => Compute::with_isa(isa.parse().expect("a kernel set"), precision)
            .expect("a kernel set of this machine"),
        None => Compute::new(precision),
    };
    let _pool = rayon::ThreadPoolBuilder::new().num_threads(1).use_current_thread().build().expect("a pool");
    println!("{} {}", c.isa(), c.precision());
    let peak = peak(&c).unwrap_or(1e-9);
    println!("{:36} {:45}{peak:8.1} GF/s  100 %", "registers only", "");
    let mut table = Table { only: words.get(2).cloned(), peak };
    linears(&c, &mut table);
    attentions(&c, &mut table);
    convolutions(&c, &mut table);
    elementwise(&c, &mut table);
}

fn linears(c: &Compute, table: &mut Table) {
    for (rows, inner, width) in [
        (960, 256, 256),
        (973, 384, 1152),
        (973, 384, 384),
        (973, 384, 1536),
        (973, 1536, 384),
        (973, 768, 3072),
        (973, 3072, 768),
        (973, 1024, 4096),
        (972, 768, 96),
    ] {
        let layer = Linear::new(weight(&[width, inner]), Some(weight(&[width]))).expect("shapes fit");
        let (x, mut out) = (numbers(rows * inner), vec![0.0; rows * width]);
        let end = if width == 4 * inner { Epilogue::Gelu } else { Epilogue::None };
        let name = format!("linear {rows}x{inner}x{width}");
        table.row(&name, 2 * rows * inner * width, || layer.apply(c, &x, rows, &mut out, end));
    }
}

fn attentions(c: &Compute, table: &mut Table) {
    let norm = LayerNorm::new(weight(&[64]), weight(&[64]), 1e-5).expect("shapes fit");
    for (tokens, normed) in [(973, false), (973, true), (4 * 973, true)] {
        let (qkv, mut out) = (numbers(tokens * 3 * 384), vec![0.0; tokens * 384]);
        let qk_norm = normed.then_some((&norm, &norm));
        let spec = AttentionSpec { heads: 6, head_dim: 64, qk_norm, rope: None };
        let name = format!("attention {tokens}x6x64{}", if normed { " normed" } else { "" });
        table.row(&name, 4 * tokens * tokens * 384, || attention(c, &qkv, 1, tokens, &spec, &mut out));
    }
}

fn convolutions(c: &Compute, table: &mut Table) {
    for (h, w, inputs, outputs) in [
        (27, 36, 384, 64),
        (14, 18, 64, 64),
        (54, 72, 64, 64),
        (108, 144, 64, 64),
        (216, 288, 64, 32),
        (108, 144, 128, 128),
        (216, 288, 128, 64),
        (378, 504, 32, 32),
    ] {
        let layer = Conv2d::new(weight(&[outputs, inputs, 3, 3]), Some(weight(&[outputs])), 1, 1)
            .expect("shapes fit");
        let (x, mut out) = (numbers(h * w * inputs), vec![0.0; h * w * outputs]);
        let name = format!("conv3x3 {h}x{w} {inputs}->{outputs}");
        table.row(&name, 2 * 9 * h * w * inputs * outputs, || {
            layer.apply(c, MapRef::new(&x, h, w), &mut out, ConvInput::Relu, Epilogue::None);
        });
    }
    let layer = Conv2d::new(weight(&[384, 3, 14, 14]), Some(weight(&[384])), 14, 0).expect("shapes fit");
    let (x, mut out) = (numbers(378 * 504 * 3), vec![0.0; 972 * 384]);
    table.row("patches 378x504 3->384", 2 * 972 * 588 * 384, || {
        layer.apply(c, MapRef::new(&x, 378, 504), &mut out, ConvInput::None, Epilogue::None);
    });
    let layer = ConvTranspose2d::new(weight(&[48, 48, 4, 4]), Some(weight(&[48]))).expect("shapes fit");
    let (x, mut out) = (numbers(972 * 48), vec![0.0; 972 * 16 * 48]);
    table.row("spread 27x36 48->48 4x4", 2 * 972 * 48 * 48 * 16, || {
        layer.apply(c, MapRef::new(&x, 27, 36), &mut out);
    });
    let conv = Conv2d::new(weight(&[32, 32, 3, 3]), Some(weight(&[32])), 1, 1).expect("shapes fit");
    let point = Conv2d::new(weight(&[2, 32, 1, 1]), Some(weight(&[2])), 1, 0).expect("shapes fit");
    let (x, mut out) = (numbers(216 * 288 * 32), vec![0.0; 378 * 504 * 2]);
    let size = MapSize { rows: 378, cols: 504 };
    let map = MapRef::new(&x, 216, 288);
    let input = HeadInput { map, channels: 32, size, corners: Corners::Aligned, embedding: None };
    table.row("head 216x288 to 378x504 32->32->2", 378 * 504 * (2 * 9 * 32 * 32 + 128), || {
        let branch = HeadBranch { conv: &conv, norm: None, point: &point, out: &mut out };
        head(c, &input, &mut [branch]);
    });
}

/// Memory-bound operations: the rate is gigabytes read and written a second, without a meaningful share.
fn elementwise(c: &Compute, table: &mut Table) {
    let norm = LayerNorm::new(weight(&[384]), weight(&[384]), 1e-6).expect("shapes fit");
    let (x, mut out) = (numbers(973 * 384), vec![0.0; 973 * 384]);
    table.row("norm 973x384 (GB/s)", 8 * 973 * 384, || norm.apply(c, &x, &mut out));
    let mut x = numbers(973 * 1536);
    table.row("gelu 973x1536 (GB/s)", 8 * 973 * 1536, || activation::gelu(c, &mut x));
    let (x, mut out) = (numbers(108 * 144 * 64), vec![0.0; 4 * 108 * 144 * 64]);
    let size = MapSize { rows: 216, cols: 288 };
    table.row("bilinear 108x144x64 to 216x288 (GB/s)", 20 * 108 * 144 * 64, || {
        resize_bilinear(c, MapRef::new(&x, 108, 144), 64, size, Corners::Aligned, &mut out);
    });
}
