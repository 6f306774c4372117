//! Every product on emulated tiles (or the hardware's, where there are some) against bf16 vectors: the same rounded factors,
//! so that only the order of sums differs.

use crate::{
    AttentionSpec, Compute, Conv2d, ConvInput, ConvTranspose2d, Corners, Epilogue, HeadBranch, HeadInput,
    Isa, KeyValues, Linear, MapRef, MapSize, Precision, TokenRows, Weight, attention, head,
};

fn numbers(seed: u32, n: usize) -> Vec<f32> {
    let mut x = seed.wrapping_mul(2_654_435_761) | 1;
    let mut next = || {
        x ^= x << 13;
        x ^= x >> 17;
        x ^= x << 5;
        (x >> 8) as f32 / (1 << 23) as f32 - 1.0
    };
    (0..n).map(|_| next()).collect()
}

fn weight(seed: u32, shape: &[usize]) -> Weight {
    Weight::owned("w", shape, numbers(seed, shape.iter().product()))
}

/// Runs `op` on both and compares.
fn compare(what: &str, outputs: usize, op: impl Fn(&Compute, &mut [f32])) {
    let (Ok(vectors), Ok(tiles)) =
        (Compute::with_isa(Isa::Avx512, Precision::Bf16), Compute::with_isa(Isa::Amx, Precision::Bf16))
    else {
        eprintln!("skipped: {what} on tiles needs AVX-512-BF16");
        return;
    };
    let (mut expected, mut out) = (vec![0.5; outputs], vec![0.5; outputs]);
    op(&vectors, &mut expected);
    op(&tiles, &mut out);
    let rms = (expected.iter().map(|x| x * x).sum::<f32>() / outputs as f32).sqrt();
    assert!(rms > 1e-3, "{what}: nothing computed");
    for (i, (a, b)) in out.iter().zip(&expected).enumerate() {
        assert!((a - b).abs() < 3e-5 * rms, "{what}, output {i}: {a} on tiles, {b} on vectors, rms {rms}");
    }
}

#[test]
fn linear_layers_on_tiles_equal_those_on_vectors() {
    for (rows, inner, width) in
        [(1, 32, 32), (16, 64, 33), (17, 66, 96), (33, 9, 5), (50, 130, 64), (100, 1024, 40)]
    {
        let layer = Linear::new(weight(1, &[width, inner]), Some(weight(2, &[width]))).unwrap();
        let x = numbers(3, rows * inner);
        compare(&format!("linear {rows}x{inner}x{width}"), rows * width, |c, out| {
            layer.apply(c, &x, rows, out, Epilogue::Accumulate { gamma: None });
        });
    }
    let layer = Linear::new(weight(4, &[74, 40]), None).unwrap();
    let x = numbers(5, 20 * 40);
    compare("gated", 20 * 37, |c, out| layer.apply_swiglu(c, &x, 20, out));
}

#[test]
fn convolutions_on_tiles_equal_those_on_vectors() {
    for (h, w, inputs, outputs, k, stride, padding) in
        [(5, 7, 3, 5, 3, 1, 1), (6, 37, 48, 33, 3, 1, 1), (9, 10, 16, 8, 3, 2, 1), (28, 42, 3, 20, 14, 14, 0)]
    {
        let layer =
            Conv2d::new(weight(6, &[outputs, inputs, k, k]), Some(weight(7, &[outputs])), stride, padding)
                .unwrap();
        let x = numbers(8, h * w * inputs);
        let (oh, ow) = layer.output_size(h, w);
        compare(
            &format!("convolution {h}x{w} {inputs}->{outputs} {k}/{stride}"),
            oh * ow * outputs,
            |c, out| {
                layer.apply(c, MapRef::new(&x, h, w), out, ConvInput::Relu, Epilogue::None);
            },
        );
    }
    let layer = ConvTranspose2d::new(weight(9, &[17, 9, 2, 2]), None).unwrap();
    let x = numbers(10, 4 * 3 * 17);
    compare("transposed convolution", 4 * 3 * 4 * 9, |c, out| layer.apply(c, MapRef::new(&x, 4, 3), out));
    let (conv, point) = (weight(11, &[32, 10, 3, 3]), weight(12, &[2, 32, 1, 1]));
    let (conv, point) = (Conv2d::new(conv, None, 1, 1).unwrap(), Conv2d::new(point, None, 1, 0).unwrap());
    let x = numbers(13, 6 * 5 * 10);
    let size = MapSize { rows: 13, cols: 19 };
    compare("head", 13 * 19 * 2, |c, out| {
        let map = MapRef::new(&x, 6, 5);
        let input = HeadInput { map, channels: 10, size, corners: Corners::Aligned, embedding: None };
        head(c, &input, &mut [HeadBranch { conv: &conv, norm: None, point: &point, out }]);
    });
}

#[test]
fn attention_on_tiles_equals_that_on_vectors() {
    for (tokens, heads, head_dim) in [(1, 1, 64), (37, 2, 24), (150, 1, 48), (300, 2, 64), (40, 1, 96)] {
        let width = heads * head_dim;
        let qkv = numbers(14, tokens * 3 * width);
        let spec = AttentionSpec { heads, head_dim, qk_norm: None, rope: None };
        // The weights of the softmax are rounded to bf16 too: a score that differs in its last bit may round another way.
        let (Ok(vectors), Ok(tiles)) =
            (Compute::with_isa(Isa::Avx512, Precision::Bf16), Compute::with_isa(Isa::Amx, Precision::Bf16))
        else {
            eprintln!("skipped: attention on tiles needs AVX-512-BF16");
            return;
        };
        let (mut expected, mut out) = (vec![0.0; tokens * width], vec![0.0; tokens * width]);
        attention(&vectors, &qkv, 1, tokens, &spec, &mut expected);
        attention(&tiles, &qkv, 1, tokens, &spec, &mut out);
        let rms = (expected.iter().map(|x| x * x).sum::<f32>() / expected.len() as f32).sqrt();
        for (a, b) in out.iter().zip(&expected) {
            assert!((a - b).abs() < 2e-3 * rms, "{tokens}x{heads}x{head_dim}: {a} on tiles, {b} on vectors");
        }
        let [q, k, v] = TokenRows::split_qkv(&qkv, width);
        let mut store = KeyValues::new(&tiles, &spec, tokens);
        store.push(&spec, k, v);
        let mut streamed = vec![0.0; tokens * width];
        store.attend(&spec, q, &mut streamed);
        assert_eq!(streamed, out);
    }
}
