//! Every operation at sizes of DA3-SMALL and BASE (one view of 504×378: 27×36 patches, 973 tokens), on every kernel set of
//! this machine and on one thread, so that the rate compares with one core's peak. `cargo bench -p vidar-nn`.
#![allow(clippy::expect_used)] // a bench may stop at the first surprise

use divan::Bencher;
use divan::counter::{BytesCount, ItemsCount};
use vidar_nn::{
    AttentionSpec, Compute, Conv2d, ConvInput, ConvTranspose2d, Corners, Epilogue, Isa, LayerNorm, Linear,
    MapRef, MapSize, Precision, Weight, activation, attention, resize_bilinear,
};

fn main() {
    // A pool of this thread alone: the rate then compares with one core's peak.
    let _pool = rayon::ThreadPoolBuilder::new().num_threads(1).use_current_thread().build().expect("a pool");
    divan::main();
}

fn numbers(n: usize) -> Vec<f32> {
    (0..n).map(|i| ((i * 7919) % 2003) as f32 / 1001.5 - 1.0).collect()
}

fn weight(shape: &[usize]) -> Weight {
    Weight::owned("w", shape, numbers(shape.iter().product()))
}

/// Kernel set and precision of one row of the table.
struct How(Compute);

impl std::fmt::Display for How {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}-{}", self.0.isa(), self.0.precision())
    }
}

fn how() -> Vec<How> {
    let mut all: Vec<How> = Isa::available()
        .into_iter()
        .filter_map(|isa| Compute::with_isa(isa, Precision::F32).ok())
        .map(How)
        .collect();
    all.push(How(Compute::new(Precision::Bf16)));
    all
}

/// Items are floating-point operations, so that divan prints a rate.
fn bench(bencher: Bencher<'_, '_>, flops: usize, work: impl FnMut()) {
    bencher.counter(ItemsCount::new(flops)).bench_local(work);
}

const TOKENS: usize = 973;

macro_rules! linear {
    ($name:ident, $inner:literal, $width:literal, $epilogue:expr) => {
        #[divan::bench(args = how())]
        fn $name(bencher: Bencher<'_, '_>, how: &How) {
            let layer = Linear::new(weight(&[$width, $inner]), Some(weight(&[$width]))).expect("shapes fit");
            let x = numbers(TOKENS * $inner);
            let mut out = vec![0.0; TOKENS * $width];
            bench(bencher, 2 * TOKENS * $inner * $width, || {
                layer.apply(&how.0, &x, TOKENS, &mut out, $epilogue)
            });
        }
    };
}

linear!(linear_384_1152, 384, 1152, Epilogue::None);
linear!(linear_384_1536_gelu, 384, 1536, Epilogue::Gelu);
linear!(linear_1536_384_residual, 1536, 384, Epilogue::Accumulate { gamma: None });
linear!(linear_768_3072_gelu, 768, 3072, Epilogue::Gelu);
linear!(linear_1024_1024, 1024, 1024, Epilogue::None);

#[divan::bench(args = how())]
fn attention_973_6x64(bencher: Bencher<'_, '_>, how: &How) {
    let qkv = numbers(TOKENS * 3 * 384);
    let mut out = vec![0.0; TOKENS * 384];
    let spec = AttentionSpec { heads: 6, head_dim: 64, qk_norm: None, rope: None };
    bench(bencher, 4 * TOKENS * TOKENS * 384, || attention(&how.0, &qkv, 1, TOKENS, &spec, &mut out));
}

#[divan::bench(args = how(), sample_count = 5)]
fn attention_7784_6x64(bencher: Bencher<'_, '_>, how: &How) {
    let n = 8 * TOKENS;
    let qkv = numbers(n * 3 * 384);
    let mut out = vec![0.0; n * 384];
    let spec = AttentionSpec { heads: 6, head_dim: 64, qk_norm: None, rope: None };
    bench(bencher, 4 * n * n * 384, || attention(&how.0, &qkv, 1, n, &spec, &mut out));
}

macro_rules! conv {
    ($name:ident, $h:literal, $w:literal, $inputs:literal, $outputs:literal) => {
        #[divan::bench(args = how())]
        fn $name(bencher: Bencher<'_, '_>, how: &How) {
            let layer = Conv2d::new(weight(&[$outputs, $inputs, 3, 3]), Some(weight(&[$outputs])), 1, 1)
                .expect("fits");
            let x = numbers($h * $w * $inputs);
            let mut out = vec![0.0; $h * $w * $outputs];
            bench(bencher, 2 * 9 * $h * $w * $inputs * $outputs, || {
                layer.apply(&how.0, MapRef::new(&x, $h, $w), &mut out, ConvInput::Relu, Epilogue::None);
            });
        }
    };
}

conv!(conv3x3_108x144_64_64, 108, 144, 64, 64);
conv!(conv3x3_27x36_384_64, 27, 36, 384, 64);
conv!(conv3x3_54x72_128_128, 54, 72, 128, 128);
conv!(conv3x3_216x288_64_32, 216, 288, 64, 32);
conv!(conv3x3_378x504_32_32, 378, 504, 32, 32);

#[divan::bench(args = how())]
fn conv_transpose_27x36_48_4(bencher: Bencher<'_, '_>, how: &How) {
    let layer = ConvTranspose2d::new(weight(&[48, 48, 4, 4]), Some(weight(&[48]))).expect("shapes fit");
    let x = numbers(27 * 36 * 48);
    let mut out = vec![0.0; 27 * 36 * 16 * 48];
    bench(bencher, 2 * 27 * 36 * 16 * 48 * 48, || layer.apply(&how.0, MapRef::new(&x, 27, 36), &mut out));
}

/// Memory-bound operations: bytes read and written.
fn bench_bytes(bencher: Bencher<'_, '_>, bytes: usize, work: impl FnMut()) {
    bencher.counter(BytesCount::new(bytes)).bench_local(work);
}

#[divan::bench(args = how())]
fn layer_norm_973x384(bencher: Bencher<'_, '_>, how: &How) {
    let norm = LayerNorm::new(weight(&[384]), weight(&[384]), 1e-6).expect("shapes fit");
    let x = numbers(TOKENS * 384);
    let mut out = vec![0.0; TOKENS * 384];
    bench_bytes(bencher, 8 * TOKENS * 384, || norm.apply(&how.0, &x, &mut out));
}

#[divan::bench(args = how())]
fn gelu_973x1536(bencher: Bencher<'_, '_>, how: &How) {
    let mut x = numbers(TOKENS * 1536);
    bench_bytes(bencher, 8 * TOKENS * 1536, || activation::gelu(&how.0, &mut x));
}

#[divan::bench(args = how())]
fn bilinear_108x144_to_216x288_64(bencher: Bencher<'_, '_>, how: &How) {
    let x = numbers(108 * 144 * 64);
    let mut out = vec![0.0; 4 * 108 * 144 * 64];
    let size = MapSize { rows: 216, cols: 288 };
    bench_bytes(bencher, 20 * 108 * 144 * 64, || {
        resize_bilinear(&how.0, MapRef::new(&x, 108, 144), 64, size, Corners::Aligned, &mut out);
    });
}
