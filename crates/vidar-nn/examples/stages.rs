//! The share of a core's peak rate that each stage of a network reaches:
//! `cargo run --release -p vidar-nn --example stages [KERNELS] [PRECISION]`. Linux only (reads `/proc`).
//!
//! Every matrix operation of DA3-SMALL and DA3-BASE on one view of 504×378 is timed by itself (best of eleven) on one
//! thread, in processor time; a stage's rate is the sum of its operations over the sum of their times, ends and
//! activations included. The peak is measured in the same run: registers only. Rows are Markdown.
#![allow(clippy::print_stdout, clippy::expect_used, reason = "a measuring program")]

mod measure;

use measure::{peak, time};
use vidar_nn::{
    AttentionSpec, Compute, Conv2d, ConvInput, ConvTranspose2d, Corners, Epilogue, HeadBranch, HeadInput,
    LayerNorm, Linear, MapRef, MapSize, Precision, Weight, attention, head,
};

/// Sizes of a network.
struct Net {
    name: &'static str,
    dim: usize,
    features: usize,
    channels: [usize; 4],
}

const NETS: [Net; 2] = [
    Net { name: "SMALL", dim: 384, features: 64, channels: [48, 96, 192, 384] },
    Net { name: "BASE", dim: 768, features: 128, channels: [96, 192, 384, 768] },
];
/// Patches of a view.
const PATCHES: [usize; 2] = [27, 36];
const TOKENS: usize = 1 + PATCHES[0] * PATCHES[1];
const BLOCKS: usize = 12;

fn numbers(n: usize) -> Vec<f32> {
    (0..n).map(|i| ((i * 7919) % 2003) as f32 / 1001.5 - 1.0).collect()
}

fn weight(shape: &[usize]) -> Weight {
    Weight::owned("w", shape, numbers(shape.iter().product()))
}

/// Operations of a stage, summed.
struct Stage<'a> {
    c: &'a Compute,
    flops: f64,
    ns: f64,
}

impl<'a> Stage<'a> {
    fn new(c: &'a Compute) -> Self {
        Self { c, flops: 0.0, ns: 0.0 }
    }

    fn add(&mut self, times: usize, flops: usize, work: impl FnMut()) {
        let (best, _) = time(work);
        self.flops += (times * flops) as f64;
        self.ns += times as f64 * best;
    }

    fn row(&self, net: &str, stage: &str, peak: f64) {
        let rate = self.flops / self.ns;
        println!(
            "| {net} | {stage} | {} {} | {:.1} | {:.1} | {rate:.0} | {:.0} % |",
            self.c.isa(),
            self.c.precision(),
            self.flops / 1e9,
            self.ns / 1e6,
            100.0 * rate / peak
        );
    }

    fn linear(&mut self, times: usize, inner: usize, width: usize, end: Epilogue<'_>) {
        let layer = Linear::new(weight(&[width, inner]), Some(weight(&[width]))).expect("shapes fit");
        let (x, mut out, c) = (numbers(TOKENS * inner), vec![0.0; TOKENS * width], self.c);
        self.add(times, 2 * TOKENS * inner * width, || layer.apply(c, &x, TOKENS, &mut out, end));
    }

    fn conv(
        &mut self,
        times: usize,
        [h, w]: [usize; 2],
        inputs: usize,
        outputs: usize,
        k: usize,
        input: ConvInput,
    ) {
        let layer = Conv2d::new(weight(&[outputs, inputs, k, k]), Some(weight(&[outputs])), 1, k / 2);
        let layer = layer.expect("shapes fit");
        let (x, mut out, c) = (numbers(h * w * inputs), vec![0.0; h * w * outputs], self.c);
        self.add(times, 2 * k * k * h * w * inputs * outputs, || {
            layer.apply(c, MapRef::new(&x, h, w), &mut out, input, Epilogue::None);
        });
    }

    fn spread(&mut self, channels: usize, k: usize) {
        let layer = ConvTranspose2d::new(weight(&[channels, channels, k, k]), Some(weight(&[channels])));
        let layer = layer.expect("shapes fit");
        let [h, w] = PATCHES;
        let (x, mut out, c) = (numbers(h * w * channels), vec![0.0; h * w * k * k * channels], self.c);
        self.add(1, 2 * h * w * k * k * channels * channels, || {
            layer.apply(c, MapRef::new(&x, h, w), &mut out)
        });
    }
}

fn main() {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let precision = words.get(1).map_or(Ok(Precision::F32), |word| word.parse()).expect("a precision");
    let c = match words.first() {
        Some(isa) => Compute::with_isa(isa.parse().expect("a kernel set"), precision).expect("runs here"),
        None => Compute::new(precision),
    };
    let _pool = rayon::ThreadPoolBuilder::new().num_threads(1).use_current_thread().build().expect("a pool");
    println!("| network | stage | kernels | GFLOP | ms | GFLOP/s | of the peak |");
    println!("|---|---|---|--:|--:|--:|--:|");
    let peak = peak(&c).expect("a peak loop for these kernels");
    println!("| | registers only | {} {} | | | {peak:.0} | 100 % |", c.isa(), c.precision());
    for net in &NETS {
        backbone(&c, net).row(net.name, "backbone products", peak);
        attending(&c, net, 8, 1).row(net.name, "local attention", peak);
        attending(&c, net, 4, 4).row(net.name, "global attention, 4 views", peak);
        stages(&c, net).row(net.name, "head, projections and resizing", peak);
        fusion(&c, net).row(net.name, "head, fusion", peak);
        last(&c, net).row(net.name, "head, output convolutions", peak);
    }
}

fn backbone<'a>(c: &'a Compute, net: &Net) -> Stage<'a> {
    let (mut stage, dim) = (Stage::new(c), net.dim);
    let patches = Conv2d::new(weight(&[dim, 3, 14, 14]), Some(weight(&[dim])), 14, 0).expect("shapes fit");
    let (x, mut out) = (numbers(378 * 504 * 3), vec![0.0; (TOKENS - 1) * dim]);
    stage.add(1, 2 * (TOKENS - 1) * 588 * dim, || {
        patches.apply(c, MapRef::new(&x, 378, 504), &mut out, ConvInput::None, Epilogue::None);
    });
    let gamma = numbers(dim);
    stage.linear(BLOCKS, dim, 3 * dim, Epilogue::None);
    stage.linear(BLOCKS, dim, dim, Epilogue::Accumulate { gamma: Some(&gamma) });
    stage.linear(BLOCKS, dim, 4 * dim, Epilogue::Gelu);
    stage.linear(BLOCKS, 4 * dim, dim, Epilogue::Accumulate { gamma: Some(&gamma) });
    stage
}

/// `blocks` blocks whose queries of one view meet the keys of `views`; norms of queries and keys included.
fn attending<'a>(c: &'a Compute, net: &Net, blocks: usize, views: usize) -> Stage<'a> {
    let (mut stage, dim, tokens) = (Stage::new(c), net.dim, views * TOKENS);
    let norm = LayerNorm::new(weight(&[64]), weight(&[64]), 1e-5).expect("shapes fit");
    let spec = AttentionSpec { heads: dim / 64, head_dim: 64, qk_norm: Some((&norm, &norm)), rope: None };
    let (qkv, mut out) = (numbers(tokens * 3 * dim), vec![0.0; tokens * dim]);
    stage.add(blocks, 4 * tokens * tokens * dim, || attention(c, &qkv, 1, tokens, &spec, &mut out));
    // Per view, as the other rows.
    Stage { c, flops: stage.flops / views as f64, ns: stage.ns / views as f64 }
}

fn stages<'a>(c: &'a Compute, net: &Net) -> Stage<'a> {
    let (mut stage, [h, w], oc) = (Stage::new(c), PATCHES, net.channels);
    for channels in oc {
        stage.conv(1, PATCHES, 2 * net.dim, channels, 1, ConvInput::None);
    }
    stage.spread(oc[0], 4);
    stage.spread(oc[1], 2);
    let halve = Conv2d::new(weight(&[oc[3], oc[3], 3, 3]), Some(weight(&[oc[3]])), 2, 1).expect("shapes fit");
    let (rows, cols) = halve.output_size(h, w);
    let (x, mut out) = (numbers(h * w * oc[3]), vec![0.0; rows * cols * oc[3]]);
    stage.add(1, 18 * rows * cols * oc[3] * oc[3], || {
        halve.apply(c, MapRef::new(&x, h, w), &mut out, ConvInput::None, Epilogue::None);
    });
    let sizes = [[4 * h, 4 * w], [2 * h, 2 * w], [h, w], [rows, cols]];
    for (size, channels) in sizes.into_iter().zip(oc) {
        stage.conv(1, size, channels, net.features, 3, ConvInput::None);
    }
    stage
}

fn fusion<'a>(c: &'a Compute, net: &Net) -> Stage<'a> {
    let (mut stage, [h, w], f) = (Stage::new(c), PATCHES, net.features);
    let sizes = [[4 * h, 4 * w], [2 * h, 2 * w], [h, w], [h.div_ceil(2), w.div_ceil(2)]];
    for (size, units) in sizes.into_iter().zip([2, 2, 2, 1]) {
        stage.conv(2 * units, size, f, f, 3, ConvInput::Relu);
        stage.conv(1, size, f, f, 1, ConvInput::None);
    }
    stage
}

fn last<'a>(c: &'a Compute, net: &Net) -> Stage<'a> {
    let (mut stage, [h, w], half) = (Stage::new(c), PATCHES, net.features / 2);
    stage.conv(1, [8 * h, 8 * w], net.features, half, 3, ConvInput::None);
    let conv = Conv2d::new(weight(&[32, half, 3, 3]), Some(weight(&[32])), 1, 1).expect("shapes fit");
    let point = Conv2d::new(weight(&[2, 32, 1, 1]), Some(weight(&[2])), 1, 0).expect("shapes fit");
    let size = MapSize { rows: 14 * h, cols: 14 * w };
    let pixels = size.rows * size.cols;
    let (x, mut out) = (numbers(64 * h * w * half), vec![0.0; pixels * 2]);
    let map = MapRef::new(&x, 8 * h, 8 * w);
    let input = HeadInput { map, channels: half, size, corners: Corners::Aligned, embedding: None };
    stage.add(1, pixels * (18 * half * 32 + 4 * 32), || {
        let branch = HeadBranch { conv: &conv, norm: None, point: &point, out: &mut out };
        head(c, &input, &mut [branch]);
    });
    stage
}
