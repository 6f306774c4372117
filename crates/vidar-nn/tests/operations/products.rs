//! Linear layers and convolutions against naive f64 references, on every kernel set and precision of this machine.

use crate::common::{Conv, Numbers, all_computes, bound, conv, error_in_std, gelu, linear, wide};
use vidar_nn::{Conv2d, ConvInput, ConvTranspose2d, Epilogue, Linear, MapRef, Precision, Weight};

#[test]
fn linear_layers_match_the_reference_on_odd_and_even_sizes() {
    let mut numbers = Numbers(1);
    for (rows, inner, width) in [
        (1, 1, 1),
        (1, 9, 5),
        (3, 64, 33),
        (13, 66, 32),
        (50, 130, 97),
        (7, 384, 100),
        (97, 48, 129),
        (2, 1030, 7),
    ] {
        let (x, w, b) = (numbers.vec(rows * inner), numbers.vec(width * inner), numbers.vec(width));
        let layer = Linear::new(
            Weight::owned("w", &[width, inner], w.clone()),
            Some(Weight::owned("b", &[width], b.clone())),
        )
        .unwrap();
        let expected = linear(&x, &w, Some(&b), rows, inner, width);
        let (gamma, start) = (numbers.vec(width), numbers.vec(rows * width));
        for c in all_computes() {
            let check = |epilogue: Epilogue<'_>, expected: &[f64]| {
                let mut out = start.clone();
                layer.apply(&c, &x, rows, &mut out, epilogue);
                let error = error_in_std(&out, expected);
                assert!(error < bound(c.precision()), "{c:?} {rows}x{inner}x{width} {epilogue:?}: {error:e}");
            };
            check(Epilogue::None, &expected);
            check(Epilogue::Relu, &expected.iter().map(|x| x.max(0.0)).collect::<Vec<_>>());
            check(Epilogue::Gelu, &expected.iter().map(|x| gelu(*x)).collect::<Vec<_>>());
            let plain: Vec<f64> = expected.iter().zip(&start).map(|(y, s)| y + f64::from(*s)).collect();
            check(Epilogue::Accumulate { gamma: None }, &plain);
            check(Epilogue::Add(&start), &plain);
            let scaled: Vec<f64> = expected
                .iter()
                .enumerate()
                .map(|(i, y)| y * f64::from(gamma[i % width]) + f64::from(start[i]))
                .collect();
            check(Epilogue::Accumulate { gamma: Some(&gamma) }, &scaled);
        }
    }
}

#[test]
fn gated_layers_multiply_silu_of_the_first_half_with_the_second() {
    let mut numbers = Numbers(2);
    for (rows, inner, half) in [(5, 40, 37), (20, 64, 64), (1, 10, 1)] {
        let (x, w, b) = (numbers.vec(rows * inner), numbers.vec(2 * half * inner), numbers.vec(2 * half));
        let both = linear(&x, &w, Some(&b), rows, inner, 2 * half);
        let expected: Vec<f64> = both
            .chunks_exact(2 * half)
            .flat_map(|r| (0..half).map(|i| r[i] / (1.0 + (-r[i]).exp()) * r[half + i]).collect::<Vec<_>>())
            .collect();
        let layer =
            Linear::new(Weight::owned("w", &[2 * half, inner], w), Some(Weight::owned("b", &[2 * half], b)))
                .unwrap();
        for c in all_computes() {
            let mut out = vec![0.0; rows * half];
            layer.apply_swiglu(&c, &x, rows, &mut out);
            let error = error_in_std(&out, &expected);
            assert!(error < 2.0 * bound(c.precision()), "{c:?} {rows}x{inner}x{half}: {error:e}");
        }
    }
}

#[test]
fn convolutions_match_the_reference_for_every_kernel_stride_and_padding_of_the_network() {
    let mut numbers = Numbers(3);
    let case = |h, w, inputs, outputs, k, stride, padding| Conv {
        h,
        w,
        inputs,
        outputs,
        kernel: [k, k],
        stride,
        padding,
    };
    for p in [
        case(5, 7, 3, 5, 3, 1, 1),
        case(9, 13, 16, 33, 3, 1, 1),
        case(1, 1, 4, 6, 3, 1, 1),
        case(6, 26, 32, 32, 3, 1, 1),
        // Large enough for the way with fewer multiplications: more than a segment of tiles, odd sides, part of a panel.
        case(7, 101, 16, 33, 3, 1, 1),
        case(18, 17, 48, 64, 3, 1, 1),
        case(7, 9, 8, 17, 3, 2, 1),
        case(8, 10, 8, 16, 3, 2, 1),
        case(28, 42, 3, 20, 14, 14, 0),
        case(4, 5, 24, 31, 1, 1, 0),
        Conv { h: 6, w: 5, inputs: 2, outputs: 3, kernel: [2, 3], stride: 1, padding: 0 },
    ] {
        let [kh, kw] = p.kernel;
        let shape = [p.outputs, p.inputs, kh, kw];
        let (x, w, b) =
            (numbers.vec(p.h * p.w * p.inputs), numbers.vec(shape.iter().product()), numbers.vec(p.outputs));
        for (with_bias, relu) in [(true, false), (false, true)] {
            let bias = with_bias.then(|| Weight::owned("b", &[p.outputs], b.clone()));
            let layer =
                Conv2d::new(Weight::owned("w", &shape, w.clone()), bias, p.stride, p.padding).unwrap();
            let (expected, oh, ow) = conv(&p, &x, &w, with_bias.then_some(&b[..]), relu);
            assert_eq!(layer.output_size(p.h, p.w), (oh, ow));
            let other = numbers.vec(expected.len());
            let added: Vec<f64> = expected.iter().zip(&other).map(|(y, o)| y + f64::from(*o)).collect();
            for c in all_computes() {
                let input = if relu { ConvInput::Relu } else { ConvInput::None };
                let mut out = vec![0.0; expected.len()];
                layer.apply(&c, MapRef::new(&x, p.h, p.w), &mut out, input, Epilogue::None);
                let error = error_in_std(&out, &expected);
                assert!(error < bound(c.precision()), "{c:?} {}x{} k{kh}: {error:e}", p.h, p.w);
                layer.apply(&c, MapRef::new(&x, p.h, p.w), &mut out, input, Epilogue::Add(&other));
                let error = error_in_std(&out, &added);
                assert!(error < bound(c.precision()), "{c:?} {}x{} k{kh} added: {error:e}", p.h, p.w);
            }
        }
    }
}

#[test]
fn transposed_convolutions_spread_each_pixel_over_its_block() {
    let mut numbers = Numbers(4);
    for (h, w, inputs, outputs, k) in [(3, 5, 8, 8, 4), (4, 3, 17, 9, 2), (1, 1, 2, 1, 1), (2, 13, 48, 48, 4)]
    {
        let (x, weight, b) =
            (numbers.vec(h * w * inputs), numbers.vec(inputs * outputs * k * k), numbers.vec(outputs));
        let mut expected = vec![0.0; h * w * k * k * outputs];
        for y in 0..h * k {
            for x0 in 0..w * k {
                for o in 0..outputs {
                    let mut sum = f64::from(b[o]);
                    for i in 0..inputs {
                        let at = ((i * outputs + o) * k + y % k) * k + x0 % k;
                        sum += f64::from(x[((y / k) * w + x0 / k) * inputs + i]) * f64::from(weight[at]);
                    }
                    expected[(y * w * k + x0) * outputs + o] = sum;
                }
            }
        }
        let layer = ConvTranspose2d::new(
            Weight::owned("w", &[inputs, outputs, k, k], weight),
            Some(Weight::owned("b", &[outputs], b)),
        )
        .unwrap();
        for c in all_computes() {
            let mut out = vec![0.0; expected.len()];
            layer.apply(&c, MapRef::new(&x, h, w), &mut out);
            let error = error_in_std(&out, &expected);
            assert!(error < bound(c.precision()), "{c:?} {h}x{w} k{k}: {error:e}");
        }
    }
}

#[test]
fn empty_inputs_give_empty_or_bias_only_outputs() {
    let mut numbers = Numbers(5);
    for c in all_computes() {
        let layer = Linear::new(numbers.weight(&[4, 6]), None).unwrap();
        layer.apply(&c, &[], 0, &mut [], Epilogue::None);
        let none = Linear::new(numbers.weight(&[0, 6]), None).unwrap();
        none.apply(&c, &[0.0; 12], 2, &mut [], Epilogue::None);
        let b = Weight::owned("b", &[3], vec![1.0, 2.0, 3.0]);
        let bias_only = Linear::new(numbers.weight(&[3, 0]), Some(b)).unwrap();
        let mut out = [0.0; 6];
        bias_only.apply(&c, &[], 2, &mut out, Epilogue::None);
        assert_eq!(out, [1.0, 2.0, 3.0, 1.0, 2.0, 3.0]);
        let conv = Conv2d::new(numbers.weight(&[2, 3, 3, 3]), None, 1, 0).unwrap();
        assert_eq!(conv.output_size(2, 5), (0, 3));
        conv.apply(&c, MapRef::new(&[0.0; 30], 2, 5), &mut [], ConvInput::None, Epilogue::None);
    }
    assert_eq!(wide(&[1.0]), [1.0]);
}

/// Numbers whose rows share a part that is ten times as large as what distinguishes them.
fn with_common_part(numbers: &mut Numbers, rows: usize, width: usize) -> Vec<f32> {
    let common: Vec<f32> = numbers.vec(width).iter().map(|x| 10.0 * x).collect();
    (0..rows * width).map(|i| common[i % width] + numbers.next()).collect()
}

/// Largest error of what tells rows apart, in its own standard deviations.
fn error_beside_common_part(out: &[f32], expected: &[f64], width: usize) -> f64 {
    let rows = (expected.len() / width) as f64;
    let mut means = vec![0.0; width];
    expected.iter().enumerate().for_each(|(i, x)| means[i % width] += x / rows);
    let apart: Vec<f64> = expected.iter().enumerate().map(|(i, x)| x - means[i % width]).collect();
    let error = out.iter().zip(expected).map(|(a, b)| (f64::from(*a) - b).abs()).fold(0.0, f64::max);
    error / (apart.iter().map(|x| x * x).sum::<f64>() / apart.len() as f64).sqrt()
}

#[test]
fn bf16_keeps_what_tells_rows_apart_beside_what_they_share() {
    let mut numbers = Numbers(9);
    let (rows, inner, width) = (200, 96, 64);
    let x = with_common_part(&mut numbers, rows, inner);
    let (w, b) = (numbers.vec(width * inner), numbers.vec(width));
    let bias = Some(Weight::owned("b", &[width], b.clone()));
    let layer = Linear::new(Weight::owned("w", &[width, inner], w.clone()), bias).unwrap();
    let expected = linear(&x, &w, Some(&b), rows, inner, width);
    for c in all_computes().into_iter().filter(|c| c.precision() == Precision::Bf16) {
        let mut out = vec![0.0; rows * width];
        layer.apply(&c, &x, rows, &mut out, Epilogue::None);
        // Rounding the numbers as they are gives 9.5e-2.
        let error = error_beside_common_part(&out, &expected, width);
        assert!(error < 2e-2, "linear, {c:?}: {error:e}");
    }

    // Without a border: the zeros around a map are themselves far from what its pixels share.
    let p = Conv { h: 12, w: 11, inputs: 48, outputs: 40, kernel: [3, 3], stride: 1, padding: 0 };
    let shape = [p.outputs, p.inputs, 3, 3];
    let (x, w) = (with_common_part(&mut numbers, p.h * p.w, p.inputs), numbers.vec(shape.iter().product()));
    let layer = Conv2d::new(Weight::owned("w", &shape, w.clone()), None, 1, 0).unwrap();
    let (expected, ..) = conv(&p, &x, &w, None, false);
    for c in all_computes().into_iter().filter(|c| c.precision() == Precision::Bf16) {
        let mut out = vec![0.0; expected.len()];
        layer.apply(&c, MapRef::new(&x, p.h, p.w), &mut out, ConvInput::None, Epilogue::None);
        let error = error_beside_common_part(&out, &expected, p.outputs);
        assert!(error < 2e-2, "convolution, {c:?}: {error:e}");
    }
}

#[test]
fn a_row_that_is_not_a_number_stays_alone() {
    let mut numbers = Numbers(10);
    let (rows, inner, width) = (70, 32, 16);
    let mut x = numbers.vec(rows * inner);
    x[5 * inner + 3] = f32::NAN;
    let layer = Linear::new(numbers.weight(&[width, inner]), None).unwrap();
    for c in all_computes() {
        let mut out = vec![0.0; rows * width];
        layer.apply(&c, &x, rows, &mut out, Epilogue::Gelu);
        for (row, out) in out.chunks_exact(width).enumerate() {
            assert!(out.iter().all(|y| y.is_nan() == (row == 5)), "{c:?}, row {row}: {out:?}");
        }
    }
}
