//! Norms, activations, attention and resampling against naive f64 references.

use crate::common::{
    Numbers, all_computes, attend, bound, error_in_std, f32_computes, layer_norm, rope, wide,
};
use vidar_nn::{
    AttentionSpec, Corners, KeyValues, LayerNorm, MapRef, MapSize, RopeTable, TokenRows, Weight, activation,
    attention, attention_separate, resize_bicubic_scaled, resize_bilinear,
};

#[test]
fn gelu_is_exact_to_a_few_ulp_everywhere() {
    let x: Vec<f32> = (-60_000..=60_000).map(|i| i as f32 * 2e-4).collect();
    for c in f32_computes() {
        let mut y = x.clone();
        activation::gelu(&c, &mut y);
        for (x, y) in x.iter().zip(&y) {
            let expected = crate::common::gelu(f64::from(*x));
            let error = (f64::from(*y) - expected).abs();
            assert!(error <= 5e-8 + 3e-7 * expected.abs(), "{c:?} gelu({x}) = {y}, {expected}");
        }
    }
}

#[test]
fn exp_and_silu_hold_their_relative_accuracy_and_saturate() {
    let x: Vec<f32> = (-8700..=8800).map(|i| i as f32 * 1e-2).collect();
    for c in f32_computes() {
        let mut y = x.clone();
        activation::exp(&c, &mut y);
        for (x, y) in x.iter().zip(&y) {
            let expected = f64::from(*x).exp();
            assert!((f64::from(*y) / expected - 1.0).abs() < 3e-7, "{c:?} exp({x}) = {y}");
        }
        let mut edges = [f32::NEG_INFINITY, -200.0, 0.0, 200.0, f32::INFINITY, f32::NAN, -0.0, 1.0];
        activation::exp(&c, &mut edges);
        assert_eq!(&edges[..5], [0.0, 0.0, 1.0, f32::INFINITY, f32::INFINITY]);
        assert!(edges[5].is_nan());
        let mut y = x.clone();
        activation::silu(&c, &mut y);
        for (x, y) in x.iter().zip(&y) {
            let expected = f64::from(*x) / (1.0 + (-f64::from(*x)).exp());
            assert!(
                (f64::from(*y) - expected).abs() <= 1e-6 * expected.abs() + 1e-37,
                "{c:?} silu({x}) = {y}"
            );
        }
        let mut y = vec![-1.0, 2.0, f32::NAN, -0.5, 3.0];
        activation::relu(&c, &mut y);
        assert!(y[2].is_nan());
        assert_eq!([y[0], y[1], y[3], y[4]], [0.0, 2.0, 0.0, 3.0]);
    }
}

#[test]
fn layer_norm_matches_the_reference_for_odd_widths() {
    let mut numbers = Numbers(11);
    for (rows, n) in [(1, 1), (3, 7), (65, 64), (40, 384), (5, 1025)] {
        let (w, b) = (numbers.vec(n), numbers.vec(n));
        let x: Vec<f32> = numbers.vec(rows * n).iter().map(|x| 3.0 * x + 5.0).collect();
        let norm =
            LayerNorm::new(Weight::owned("w", &[n], w.clone()), Weight::owned("b", &[n], b.clone()), 1e-6)
                .unwrap();
        let expected = layer_norm(&wide(&x), &w, &b, 1e-6);
        for c in f32_computes() {
            let mut out = vec![0.0; x.len()];
            norm.apply(&c, &x, &mut out);
            let error = error_in_std(&out, &expected);
            assert!(error < 5e-6, "{rows}x{n} {}: {error:e}", c.isa());
            let mut in_place = x.clone();
            norm.apply_in_place(&c, &mut in_place);
            assert_eq!(out, in_place);
        }
    }
}

#[test]
fn attention_matches_the_reference_with_and_without_norm_and_rotation() {
    let mut numbers = Numbers(12);
    for (sequences, tokens, heads, d, dressed) in [
        (1, 1, 1, 64, false),
        (2, 13, 3, 24, false),
        (1, 70, 2, 64, true),
        (2, 37, 1, 48, false),
        (1, 33, 2, 96, true),
        (1, 300, 1, 64, true),
    ] {
        let width = heads * d;
        let qkv: Vec<f32> = numbers.vec(sequences * tokens * 3 * width).iter().map(|x| 2.0 * x).collect();
        let vectors: Vec<Vec<f32>> =
            (0..4).map(|_| numbers.vec(d).iter().map(|x| 1.0 + 0.3 * x).collect()).collect();
        let norm = |w: &Vec<f32>, b: &Vec<f32>| {
            LayerNorm::new(Weight::owned("w", &[d], w.clone()), Weight::owned("b", &[d], b.clone()), 1e-5)
                .unwrap()
        };
        let norms = (norm(&vectors[0], &vectors[1]), norm(&vectors[2], &vectors[3]));
        let positions: Vec<[f32; 2]> = (0..tokens).map(|t| [(t / 5) as f32, (t % 5) as f32]).collect();
        let table = RopeTable::new(&positions, d, 100.0);
        let spec = AttentionSpec {
            heads,
            head_dim: d,
            qk_norm: dressed.then_some((&norms.0, &norms.1)),
            rope: dressed.then_some(&table),
        };
        let mut expected = vec![0.0; sequences * tokens * width];
        for s in 0..sequences {
            for head in 0..heads {
                let take = |which: usize| -> Vec<f64> {
                    (0..tokens)
                        .flat_map(|t| {
                            let at = ((s * tokens + t) * 3 + which) * width + head * d;
                            let mut x = wide(&qkv[at..at + d]);
                            if dressed && which < 2 {
                                x = layer_norm(&x, &vectors[2 * which], &vectors[2 * which + 1], 1e-5);
                                rope(&mut x, positions[t], 100.0);
                            }
                            x
                        })
                        .collect()
                };
                let y = attend(&take(0), &take(1), &take(2), d);
                for t in 0..tokens {
                    let at = (s * tokens + t) * width + head * d;
                    expected[at..at + d].copy_from_slice(&y[t * d..(t + 1) * d]);
                }
            }
        }
        for c in all_computes() {
            let mut out = vec![0.0; expected.len()];
            attention(&c, &qkv, sequences, tokens, &spec, &mut out);
            let error = error_in_std(&out, &expected);
            assert!(error < 4.0 * bound(c.precision()), "{c:?} {sequences}x{tokens}x{heads}x{d}: {error:e}");
            // The first sequence's last queries alone give the same numbers as within the whole.
            if !dressed {
                let [q, k, v] = TokenRows::split_qkv(&qkv[..tokens * 3 * width], width);
                let skip = tokens / 2;
                let some =
                    TokenRows { data: &q.data[skip * q.stride..], stride: q.stride, tokens: tokens - skip };
                let mut part = vec![0.0; (tokens - skip) * width];
                attention_separate(&c, some, k, v, &spec, &mut part);
                assert_eq!(part, out[skip * width..tokens * width], "{c:?}");
            }
        }
    }
}

#[test]
fn bilinear_resampling_matches_the_reference_for_both_corner_rules() {
    let mut numbers = Numbers(13);
    for (h, w, c, oh, ow) in [
        (3, 5, 7, 9, 4),
        (14, 18, 64, 27, 36),
        (1, 1, 3, 4, 5),
        (5, 1, 16, 2, 3),
        (4, 6, 33, 4, 6),
        (7, 9, 2, 1, 1),
    ] {
        let x = numbers.vec(h * w * c);
        for corners in [Corners::Aligned, Corners::Edges] {
            let source = |i: usize, n: usize, m: usize| -> (usize, usize, f64) {
                let s = match corners {
                    Corners::Aligned if m > 1 => i as f64 * (n - 1) as f64 / (m - 1) as f64,
                    Corners::Aligned => 0.0,
                    Corners::Edges => ((i as f64 + 0.5) * n as f64 / m as f64 - 0.5).max(0.0),
                };
                let low = (s.floor() as usize).min(n - 1);
                (low, (low + 1).min(n - 1), s - low as f64)
            };
            let mut expected = Vec::new();
            for y in 0..oh {
                let (y0, y1, ty) = source(y, h, oh);
                for x0 in 0..ow {
                    let (l, r, tx) = source(x0, w, ow);
                    for i in 0..c {
                        let at = |y: usize, x0: usize| f64::from(x[(y * w + x0) * c + i]);
                        let top = at(y0, l) * (1.0 - tx) + at(y0, r) * tx;
                        let bottom = at(y1, l) * (1.0 - tx) + at(y1, r) * tx;
                        expected.push(top * (1.0 - ty) + bottom * ty);
                    }
                }
            }
            for compute in f32_computes() {
                let mut out = vec![0.0; expected.len()];
                let size = MapSize { rows: oh, cols: ow };
                resize_bilinear(&compute, MapRef::new(&x, h, w), c, size, corners, &mut out);
                let error = error_in_std(&out, &expected);
                assert!(error < 1e-5, "{h}x{w}x{c} to {oh}x{ow} {corners:?} {}: {error:e}", compute.isa());
            }
        }
    }
}

#[test]
fn bicubic_resampling_takes_its_scales_from_the_caller() {
    let mut numbers = Numbers(14);
    let (h, w, c, oh, ow) = (37, 37, 5, 27, 36);
    let x = numbers.vec(h * w * c);
    let scales = [27.1 / 37.0, 36.1 / 37.0];
    let cubic = |t: f64| -> f64 {
        let (a, t) = (-0.75, t.abs());
        if t <= 1.0 {
            (a + 2.0) * t.powi(3) - (a + 3.0) * t.powi(2) + 1.0
        } else if t < 2.0 {
            a * t.powi(3) - 5.0 * a * t.powi(2) + 8.0 * a * t - 4.0 * a
        } else {
            0.0
        }
    };
    let mut expected = Vec::new();
    for y in 0..oh {
        let sy = (y as f64 + 0.5) / scales[0] - 0.5;
        for x0 in 0..ow {
            let sx = (x0 as f64 + 0.5) / scales[1] - 0.5;
            for i in 0..c {
                let mut sum = 0.0;
                for ky in -1..=2i32 {
                    for kx in -1..=2i32 {
                        let (py, px) = (sy.floor() as i32 + ky, sx.floor() as i32 + kx);
                        let weight = cubic(sy - f64::from(py)) * cubic(sx - f64::from(px));
                        let (py, px) = (py.clamp(0, 36) as usize, px.clamp(0, 36) as usize);
                        sum += weight * f64::from(x[(py * w + px) * c + i]);
                    }
                }
                expected.push(sum);
            }
        }
    }
    let mut out = vec![0.0; expected.len()];
    resize_bicubic_scaled(MapRef::new(&x, h, w), c, oh, ow, scales, &mut out);
    let error = error_in_std(&out, &expected);
    assert!(error < 3e-5, "{error:e}");
}

#[test]
fn pushing_views_one_by_one_equals_one_long_sequence() {
    const D: usize = 48;
    let (views, tokens) = (3, 77); // views that do not end with a block of keys
    let mut numbers = Numbers(32);
    let qkv = numbers.vec(views * tokens * 3 * D);
    let norm = LayerNorm::new(numbers.weight(&[24]), numbers.weight(&[24]), 1e-5).unwrap();
    let positions: Vec<[f32; 2]> = (0..tokens).map(|t| [if t == 0 { 0.0 } else { 1.0 }; 2]).collect();
    let rope = RopeTable::new(&positions, 24, 100.0);
    let spec = AttentionSpec { heads: 2, head_dim: 24, qk_norm: Some((&norm, &norm)), rope: Some(&rope) };
    for c in all_computes() {
        let mut whole = vec![0.0; views * tokens * D];
        attention(&c, &qkv, 1, views * tokens, &spec, &mut whole);
        let mut store = KeyValues::new(&c, &spec, views * tokens);
        for view in qkv.chunks_exact(tokens * 3 * D) {
            let [_, k, v] = TokenRows::split_qkv(view, D);
            store.push(&spec, k, v);
        }
        assert_eq!(store.tokens(), views * tokens);
        for (view, whole) in qkv.chunks_exact(tokens * 3 * D).zip(whole.chunks_exact(tokens * D)) {
            let [q, _, _] = TokenRows::split_qkv(view, D);
            let mut out = vec![0.0; tokens * D];
            store.attend(&spec, q, &mut out);
            assert_eq!(out, whole, "{c:?}");
        }
    }
}
