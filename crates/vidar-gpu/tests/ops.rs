//! Operations against those of the CPU, on odd sizes.

#![cfg(feature = "device")]
#![allow(clippy::unwrap_used)]

mod common;

use common::{any_device, assert_near, numbers};
use vidar_gpu::ops::{
    Activation, AttendSpec, Convolution, End, Grid, MapShape, Norm, PointLayer, Rotation, Rows, Spread, add,
    attend, convolve, copy_rows, embed, layer_norm, patchify, point, prepare_heads, product, product_into,
    resample, spread,
};
use vidar_gpu::{Gpu, Matrix, Recorder, Storage};
use vidar_nn::{
    AttentionSpec, Compute, Conv2d, ConvInput, ConvTranspose2d, Corners, Epilogue, GridEmbedding, LayerNorm,
    Linear, MapRef, MapSize, RopeTable, Weight, attention, resize_bilinear,
};

const TIGHT: f32 = 2e-5;

fn read(recorder: &mut Recorder, buffer: &vidar_gpu::Buffer, len: usize) -> Vec<f32> {
    recorder.read(buffer, 0, len).unwrap()
}

struct Layer {
    weight: Vec<f32>,
    bias: Vec<f32>,
    cpu: Linear,
}

fn layer(inputs: usize, outputs: usize) -> Layer {
    let (weight, bias) = (numbers(3, inputs * outputs), numbers(4, outputs));
    let owned = Weight::owned("w", &[outputs, inputs], weight.clone());
    let cpu = Linear::new(owned, Some(Weight::owned("b", &[outputs], bias.clone()))).unwrap();
    Layer { weight, bias, cpu }
}

#[test]
fn products_of_all_sizes_are_those_of_the_cpu() {
    let Some(gpu) = any_device() else { return };
    let c = Compute::default();
    // Small, large and narrow tiles, with rows, columns and inner lengths that fill none.
    for (rows, inputs, outputs) in [(1, 4, 4), (67, 36, 70), (130, 20, 31), (3, 588, 48), (1300, 12, 1290)] {
        let l = layer(inputs, outputs);
        let x = numbers(5, rows * inputs);
        let mut expected = vec![0.0; rows * outputs];
        l.cpu.apply(&c, &x, rows, &mut expected, Epilogue::Gelu);
        let matrix =
            Matrix::new(&gpu, "w", &l.weight, Some(&l.bias), [outputs, inputs], Storage::F32).unwrap();
        let (x, out) = (gpu.upload("x", &x).unwrap(), gpu.buffer("y", rows * outputs).unwrap());
        let mut recorder = Recorder::new(&gpu);
        product_into(&mut recorder, &x, rows, &matrix, &out, End::Gelu).unwrap();
        let found = read(&mut recorder, &out, rows * outputs);
        assert_near(&format!("{rows}x{inputs}x{outputs}"), &found, &expected, TIGHT);
    }
}

#[test]
fn every_end_of_a_product_does_what_it_says() {
    let Some(gpu) = any_device() else { return };
    let c = Compute::default();
    let (rows, inputs, outputs) = (37, 24, 52);
    let l = layer(inputs, outputs);
    let (x, held, gamma) = (numbers(6, rows * inputs), numbers(7, rows * outputs), numbers(8, outputs));
    let matrix = Matrix::new(&gpu, "w", &l.weight, Some(&l.bias), [outputs, inputs], Storage::F32).unwrap();
    let on_device = gpu.upload("x", &x).unwrap();
    let (gamma_there, other) = (gpu.upload("gamma", &gamma).unwrap(), gpu.upload("other", &held).unwrap());
    let ends = [
        (End::Store, Epilogue::None),
        (End::Relu, Epilogue::Relu),
        (End::Accumulate, Epilogue::Accumulate { gamma: None }),
        (End::Scaled(&gamma_there), Epilogue::Accumulate { gamma: Some(&gamma) }),
        (End::Add(&other, 0), Epilogue::Add(&held)),
    ];
    for (i, (end, epilogue)) in ends.into_iter().enumerate() {
        let mut expected = held.clone();
        l.cpu.apply(&c, &x, rows, &mut expected, epilogue);
        let out = gpu.upload("y", &held).unwrap();
        let mut recorder = Recorder::new(&gpu);
        product_into(&mut recorder, &on_device, rows, &matrix, &out, end).unwrap();
        assert_near(&format!("end {i}"), &read(&mut recorder, &out, rows * outputs), &expected, TIGHT);
    }
}

#[test]
fn a_gated_unit_pairs_the_halves_of_its_outputs() {
    let Some(gpu) = any_device() else { return };
    for (rows, inputs, outputs) in [(19, 40, 112), (5, 8, 24), (140, 16, 256)] {
        let l = layer(inputs, outputs);
        let x = numbers(9, rows * inputs);
        let mut expected = vec![0.0; rows * outputs / 2];
        l.cpu.apply_swiglu(&Compute::default(), &x, rows, &mut expected);
        let matrix = Matrix::gated(&gpu, "w12", &l.weight, &l.bias, [outputs, inputs], Storage::F32).unwrap();
        let (x, out) = (gpu.upload("x", &x).unwrap(), gpu.buffer("y", rows * outputs / 2).unwrap());
        let mut recorder = Recorder::new(&gpu);
        let to = Rows::of(&out, outputs / 2);
        product(&mut recorder, Rows::of(&x, inputs), rows, &matrix, to, End::Gated).unwrap();
        assert_near("gated", &read(&mut recorder, &out, rows * outputs / 2), &expected, TIGHT);
    }
}

#[test]
fn packed_weights_lose_no_more_than_their_format() {
    let Some(gpu) = any_device() else { return };
    let (rows, inputs, outputs) = (21, 64, 40);
    let l = layer(inputs, outputs);
    let x = numbers(10, rows * inputs);
    let on_device = gpu.upload("x", &x).unwrap();
    for storage in [Storage::Bf16, Storage::F16] {
        let rounded: Vec<f32> = match storage {
            Storage::Bf16 => l.weight.iter().map(|w| half::bf16::from_f32(*w).to_f32()).collect(),
            _ => l.weight.iter().map(|w| half::f16::from_f32(*w).to_f32()).collect(),
        };
        let cpu = Linear::new(Weight::owned("w", &[outputs, inputs], rounded), None).unwrap();
        let mut expected = vec![0.0; rows * outputs];
        cpu.apply(&Compute::default(), &x, rows, &mut expected, Epilogue::None);
        let matrix = Matrix::new(&gpu, "w", &l.weight, None, [outputs, inputs], storage).unwrap();
        let out = gpu.buffer("y", rows * outputs).unwrap();
        let mut recorder = Recorder::new(&gpu);
        product_into(&mut recorder, &on_device, rows, &matrix, &out, End::Store).unwrap();
        let found = read(&mut recorder, &out, rows * outputs);
        assert_near(&format!("{storage:?}"), &found, &expected, TIGHT);
    }
}

#[test]
fn convolutions_are_those_of_the_cpu() {
    let Some(gpu) = any_device() else { return };
    let c = Compute::default();
    // (rows, columns, inputs, outputs, side, stride)
    for (rows, columns, inputs, outputs, side, stride) in [
        (5, 7, 8, 12, 3, 1),
        (9, 4, 12, 40, 3, 2),
        (1, 1, 4, 32, 3, 1),
        (6, 5, 20, 8, 1, 1),
        (91, 92, 4, 72, 3, 1),
    ] {
        let weight = numbers(11, outputs * inputs * side * side);
        let bias = numbers(12, outputs);
        let x = numbers(13, rows * columns * inputs);
        let owned = Weight::owned("w", &[outputs, inputs, side, side], weight.clone());
        let cpu_bias = Weight::owned("b", &[outputs], bias.clone());
        let cpu = Conv2d::new(owned, Some(cpu_bias), stride, side / 2).unwrap();
        let (oh, ow) = cpu.output_size(rows, columns);
        let layer = Convolution::new(
            &gpu,
            "w",
            &weight,
            Some(&bias),
            [outputs, inputs, side],
            (stride, Storage::F32),
        )
        .unwrap();
        let shape = MapShape { rows, columns, channels: inputs };
        let on_device = gpu.upload("x", &x).unwrap();
        for relu in [false, true] {
            if relu && side == 1 {
                continue;
            }
            let mut expected = vec![0.5; oh * ow * outputs];
            let input = if relu { ConvInput::Relu } else { ConvInput::None };
            let end = Epilogue::Accumulate { gamma: None };
            cpu.apply(&c, MapRef::new(&x, rows, columns), &mut expected, input, end);
            let out = gpu.upload("y", &vec![0.5; oh * ow * outputs]).unwrap();
            let mut recorder = Recorder::new(&gpu);
            let to =
                convolve(&mut recorder, (&on_device, shape), &layer, &out, relu, End::Accumulate).unwrap();
            assert_eq!((to.rows, to.columns, to.channels), (oh, ow, outputs));
            let found = read(&mut recorder, &out, expected.len());
            assert_near(&format!("{rows}x{columns} relu {relu}"), &found, &expected, TIGHT);
        }
    }
}

#[test]
fn spreading_is_that_of_the_cpu() {
    let Some(gpu) = any_device() else { return };
    for (rows, columns, inputs, outputs, side) in [(3, 5, 8, 12, 4), (4, 3, 12, 6, 2)] {
        let (weight, bias) = (numbers(14, inputs * outputs * side * side), numbers(15, outputs));
        let x = numbers(16, rows * columns * inputs);
        let owned = Weight::owned("w", &[inputs, outputs, side, side], weight.clone());
        let cpu = ConvTranspose2d::new(owned, Some(Weight::owned("b", &[outputs], bias.clone()))).unwrap();
        let mut expected = vec![0.0; rows * columns * side * side * outputs];
        cpu.apply(&Compute::default(), MapRef::new(&x, rows, columns), &mut expected);
        let layer = Spread::new(&gpu, "w", &weight, &bias, [inputs, outputs, side], Storage::F32).unwrap();
        let (x, out) = (gpu.upload("x", &x).unwrap(), gpu.buffer("y", expected.len()).unwrap());
        let mut recorder = Recorder::new(&gpu);
        spread(&mut recorder, (&x, MapShape { rows, columns, channels: inputs }), &layer, &out).unwrap();
        assert_near("spread", &read(&mut recorder, &out, expected.len()), &expected, TIGHT);
    }
}

fn cpu_norm(width: usize, seed: u32) -> (LayerNorm, Vec<f32>, Vec<f32>) {
    let (weight, bias) = (numbers(seed, width), numbers(seed + 1, width));
    let owned = |v: &[f32]| Weight::owned("n", &[width], v.to_vec());
    (LayerNorm::new(owned(&weight), owned(&bias), 1e-5).unwrap(), weight, bias)
}

#[test]
fn layer_norm_is_that_of_the_cpu_also_between_strides() {
    let Some(gpu) = any_device() else { return };
    for (rows, width) in [(1, 4), (9, 52), (70, 384)] {
        let (cpu, weight, bias) = cpu_norm(width, 17);
        let stride = width + 8;
        let x: Vec<f32> = numbers(19, rows * stride).iter().map(|v| 3.0 + v).collect();
        let mut expected = vec![0.25; rows * stride];
        for (out, x) in expected.chunks_exact_mut(stride).zip(x.chunks_exact(stride)) {
            cpu.apply(&Compute::default(), &x[4..4 + width], &mut out[8..8 + width]);
        }
        let norm = Norm::new(&gpu, "n", &weight, &bias, 1e-5).unwrap();
        let (x, out) = (gpu.upload("x", &x).unwrap(), gpu.upload("y", &vec![0.25; rows * stride]).unwrap());
        let mut recorder = Recorder::new(&gpu);
        let at = |buffer, at| Rows { buffer, at, stride };
        layer_norm(&mut recorder, &norm, at(&x, 4), rows, at(&out, 8)).unwrap();
        assert_near("norm", &read(&mut recorder, &out, rows * stride), &expected, TIGHT);
    }
}

fn attention_case(
    gpu: &Gpu,
    (sequences, tokens): (usize, usize),
    (heads, head_dim): (usize, usize),
    prepared: bool,
) {
    let width = heads * head_dim;
    let qkv: Vec<f32> = numbers(20, sequences * tokens * 3 * width).iter().map(|v| 2.0 * v).collect();
    let positions: Vec<[f32; 2]> = (0..tokens).map(|t| [(t / 5) as f32, (t % 5) as f32]).collect();
    let table = prepared.then(|| RopeTable::new(&positions, head_dim, 100.0));
    let (q_norm, qw, qb) = cpu_norm(head_dim, 21);
    let (k_norm, kw, kb) = cpu_norm(head_dim, 23);
    let norms = prepared.then_some((&q_norm, &k_norm));
    let spec = AttentionSpec { heads, head_dim, qk_norm: norms, rope: table.as_ref() };
    let mut expected = vec![0.0; sequences * tokens * width];
    attention(&Compute::default(), &qkv, sequences, tokens, &spec, &mut expected);

    let (buffer, out) = (gpu.upload("qkv", &qkv).unwrap(), gpu.buffer("y", expected.len()).unwrap());
    let mut recorder = Recorder::new(gpu);
    if let Some(table) = &table {
        let rotation = Rotation::new(gpu, table.cos(), table.sin(), head_dim).unwrap();
        let q = Norm::new(gpu, "q", &qw, &qb, 1e-5).unwrap();
        let k = Norm::new(gpu, "k", &kw, &kb, 1e-5).unwrap();
        let tokens = sequences * tokens;
        prepare_heads(&mut recorder, &buffer, tokens, (heads, head_dim), Some((&q, &k)), Some(&rotation))
            .unwrap();
    }
    let spec = AttendSpec { heads, head_dim, queries: (0, tokens), keys: (0, tokens), out: 0, sequences };
    attend(&mut recorder, &buffer, &out, &spec).unwrap();
    let found = read(&mut recorder, &out, expected.len());
    assert_near(&format!("attention {sequences} x {tokens}, {heads} x {head_dim}"), &found, &expected, TIGHT);
}

#[test]
fn attention_is_that_of_the_cpu() {
    let Some(gpu) = any_device() else { return };
    attention_case(&gpu, (1, 1), (1, 4), false);
    attention_case(&gpu, (2, 37), (3, 20), false);
    attention_case(&gpu, (3, 65), (2, 16), true);
    attention_case(&gpu, (1, 200), (2, 64), true);
}

#[test]
fn some_queries_meet_all_keys() {
    let Some(gpu) = any_device() else { return };
    let (tokens, heads, head_dim) = (90, 2, 16);
    let qkv = numbers(25, tokens * 3 * heads * head_dim);
    let width = heads * head_dim;
    let run = |parts: &[(usize, usize)]| {
        let (buffer, out) = (gpu.upload("qkv", &qkv).unwrap(), gpu.buffer("y", tokens * width).unwrap());
        let mut recorder = Recorder::new(&gpu);
        for queries in parts {
            let spec = AttendSpec {
                heads,
                head_dim,
                queries: *queries,
                keys: (0, tokens),
                out: queries.0,
                sequences: 1,
            };
            attend(&mut recorder, &buffer, &out, &spec).unwrap();
        }
        read(&mut recorder, &out, tokens * width)
    };
    assert_eq!(run(&[(0, 90)]), run(&[(0, 31), (31, 59)]));
}

#[test]
fn enlarging_and_embedding_are_those_of_the_cpu() {
    let Some(gpu) = any_device() else { return };
    // (channels): one whose halves divide by four, one whose halves do not.
    for (channels, from, to) in [(8, (3, 5), (7, 9)), (12, (4, 1), (5, 3)), (4, (1, 6), (1, 1))] {
        let x = numbers(26, from.0 * from.1 * channels);
        let grid = GridEmbedding {
            by_col: numbers(27, to.1 * channels / 2),
            by_row: numbers(28, to.0 * channels / 2),
        };
        let mut expected = vec![0.0; to.0 * to.1 * channels];
        let map = MapRef::new(&x, from.0, from.1);
        let size = MapSize { rows: to.0, cols: to.1 };
        resize_bilinear(&Compute::default(), map, channels, size, Corners::Aligned, &mut expected);
        let plain = expected.clone();
        grid.add_to(&mut expected, channels, MapSize { rows: to.0, cols: to.1 });
        let shape = MapShape { rows: from.0, columns: from.1, channels };
        let target = MapShape { rows: to.0, columns: to.1, channels };
        let there = Grid::new(&gpu, &grid.by_col, &grid.by_row, target).unwrap();
        let (x, out) = (gpu.upload("x", &x).unwrap(), gpu.buffer("y", expected.len()).unwrap());
        let mut recorder = Recorder::new(&gpu);
        resample(&mut recorder, (&x, shape), to, None, &out).unwrap();
        assert_near("resample", &read(&mut recorder, &out, plain.len()), &plain, TIGHT);
        embed(&mut recorder, &there, &out).unwrap();
        assert_near("embed", &read(&mut recorder, &out, plain.len()), &expected, TIGHT);
        resample(&mut recorder, (&x, shape), to, Some(&there), &out).unwrap();
        assert_near("resample and embed", &read(&mut recorder, &out, plain.len()), &expected, TIGHT);
    }
}

#[test]
fn the_end_of_a_head_is_norm_cut_layer_and_activation() {
    let Some(gpu) = any_device() else { return };
    let (pixels, outputs) = (77, 4);
    let (x, weight, bias) = (numbers(29, pixels * 32), numbers(30, outputs * 32), numbers(31, outputs));
    let (cpu, norm_weight, norm_bias) = cpu_norm(32, 32);
    let on_device = gpu.upload("x", &x).unwrap();
    let activations = [Activation::None, Activation::Exp, Activation::OnePlusExp, Activation::Relu];
    for has_norm in [false, true] {
        let mut inner = x.clone();
        if has_norm {
            cpu.apply_in_place(&Compute::default(), &mut inner);
        }
        let mut expected = vec![0.0; outputs * pixels];
        for (pixel, inner) in inner.chunks_exact(32).enumerate() {
            for o in 0..outputs {
                let products = inner.iter().zip(&weight[o * 32..]).map(|(x, w)| x.max(0.0) * w);
                let sum = bias[o] + products.sum::<f32>();
                expected[o * pixels + pixel] = match o {
                    0 => sum,
                    1 => sum.exp(),
                    2 => 1.0 + sum.exp(),
                    _ => sum.max(0.0),
                };
            }
        }
        let norm = has_norm.then(|| Norm::new(&gpu, "n", &norm_weight, &norm_bias, 1e-5).unwrap());
        let layer = PointLayer::new(&gpu, "w", &weight, &bias, norm).unwrap();
        let out = gpu.buffer("y", 3 + outputs * pixels).unwrap();
        let mut recorder = Recorder::new(&gpu);
        point(&mut recorder, (&on_device, pixels), &layer, &activations, (&out, 3)).unwrap();
        let found = recorder.read(&out, 3, outputs * pixels).unwrap();
        assert_near(&format!("norm {has_norm}"), &found, &expected, TIGHT);
    }
}

#[test]
fn patches_are_rows_and_numbers_are_added() {
    let Some(gpu) = any_device() else { return };
    let (rows, columns, side) = (4, 6, 2);
    let x = numbers(34, 5 + 3 * rows * columns);
    let mut expected = Vec::new();
    for (patch_row, patch_column) in (0..2).flat_map(|r| (0..3).map(move |c| (r, c))) {
        for plane in 0..3 {
            for (r, c) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
                let (row, column) = (patch_row * side + r, patch_column * side + c);
                expected.push(x[5 + (plane * rows + row) * columns + column]);
            }
        }
    }
    let (x, out) = (gpu.upload("x", &x).unwrap(), gpu.buffer("y", expected.len()).unwrap());
    let mut recorder = Recorder::new(&gpu);
    patchify(&mut recorder, (&x, 5), [rows, columns, side], &out).unwrap();
    assert_eq!(read(&mut recorder, &out, expected.len()), expected);
    add(&mut recorder, (&out, 2), (&x, 1), 7).unwrap();
    recorder.copy((&x, 1), (&out, 0), 7);
    let before = numbers(34, 12);
    let sums: Vec<f32> = (0..7).map(|i| before[1 + i] + expected[2 + i]).collect();
    assert_eq!(recorder.read(&out, 0, 7).unwrap(), sums);
}

#[test]
fn rows_are_copied_between_strides() {
    let Some(gpu) = any_device() else { return };
    let x = numbers(35, 40);
    let (from, out) = (gpu.upload("x", &x).unwrap(), gpu.upload("y", &[0.0; 30]).unwrap());
    let mut recorder = Recorder::new(&gpu);
    let (from, to) = (Rows { buffer: &from, at: 3, stride: 7 }, Rows { buffer: &out, at: 1, stride: 5 });
    copy_rows(&mut recorder, from, (4, 3), to).unwrap();
    let mut expected = vec![0.0; 30];
    for row in 0..4 {
        expected[1 + 5 * row..][..3].copy_from_slice(&x[3 + 7 * row..][..3]);
    }
    assert_eq!(read(&mut recorder, &out, 30), expected);
}
