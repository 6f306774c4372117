//! The fused end of a head against its parts, one after the other in f64.

use crate::common::{Conv, Numbers, all_computes, bound, conv, error_in_std, layer_norm, wide};
use vidar_nn::{
    Conv2d, Corners, GridEmbedding, HeadBranch, HeadInput, LayerNorm, MapRef, MapSize, Weight, head,
};

fn upsample(x: &[f32], h: usize, w: usize, c: usize, size: MapSize) -> Vec<f64> {
    let source = |i: usize, n: usize, m: usize| {
        let s = if m > 1 { i as f64 * (n - 1) as f64 / (m - 1) as f64 } else { 0.0 };
        let low = (s.floor() as usize).min(n - 1);
        (low, (low + 1).min(n - 1), s - low as f64)
    };
    let mut out = Vec::new();
    for y in 0..size.rows {
        let (t, b, ty) = source(y, h, size.rows);
        for x0 in 0..size.cols {
            let (l, r, tx) = source(x0, w, size.cols);
            for i in 0..c {
                let at = |y: usize, x0: usize| f64::from(x[(y * w + x0) * c + i]);
                let top = at(t, l) * (1.0 - tx) + at(t, r) * tx;
                let bottom = at(b, l) * (1.0 - tx) + at(b, r) * tx;
                out.push(top * (1.0 - ty) + bottom * ty);
            }
        }
    }
    out
}

#[test]
fn the_fused_head_equals_its_parts_for_one_and_two_branches() {
    let mut numbers = Numbers(21);
    for (h, w, c, size, middle, outputs) in [
        (5, 7, 32, MapSize { rows: 11, cols: 13 }, 32, 2),
        (6, 6, 18, MapSize { rows: 6, cols: 6 }, 20, 7),
        (3, 2, 8, MapSize { rows: 50, cols: 29 }, 33, 1),
        (9, 14, 16, MapSize { rows: 31, cols: 45 }, 40, 2),
    ] {
        let x = numbers.vec(h * w * c);
        let embedding =
            GridEmbedding { by_col: numbers.vec(size.cols * c / 2), by_row: numbers.vec(size.rows * c / 2) };
        let mut map = upsample(&x, h, w, c, size);
        for (i, value) in map.iter_mut().enumerate() {
            let (pixel, channel) = (i / c, i % c);
            *value += f64::from(if channel < c / 2 {
                embedding.by_col[pixel % size.cols * (c / 2) + channel]
            } else {
                embedding.by_row[pixel / size.cols * (c / 2) + channel - c / 2]
            });
        }
        let map: Vec<f32> = map.iter().map(|x| *x as f32).collect();
        let mut layers = Vec::new();
        for dressed in [false, true] {
            let (w3, b3) = (numbers.vec(middle * c * 9), numbers.vec(middle));
            let (w1, b1) = (numbers.vec(outputs * middle), numbers.vec(outputs));
            let (nw, nb) = (numbers.vec(middle), numbers.vec(middle));
            let shape = Conv {
                h: size.rows,
                w: size.cols,
                inputs: c,
                outputs: middle,
                kernel: [3, 3],
                stride: 1,
                padding: 1,
            };
            let mut between = conv(&shape, &map, &w3, Some(&b3), false).0;
            if dressed {
                between = layer_norm(&between, &nw, &nb, 1e-5);
            }
            let expected: Vec<f64> = between
                .chunks_exact(middle)
                .flat_map(|x| {
                    (0..outputs)
                        .map(|o| {
                            let dot: f64 =
                                (0..middle).map(|k| x[k].max(0.0) * f64::from(w1[o * middle + k])).sum();
                            dot + f64::from(b1[o])
                        })
                        .collect::<Vec<_>>()
                })
                .collect();
            let conv3 = Conv2d::new(
                Weight::owned("w", &[middle, c, 3, 3], w3),
                Some(Weight::owned("b", &[middle], b3)),
                1,
                1,
            );
            let point = Conv2d::new(
                Weight::owned("w", &[outputs, middle, 1, 1], w1),
                Some(Weight::owned("b", &[outputs], b1)),
                1,
                0,
            );
            let norm =
                LayerNorm::new(Weight::owned("w", &[middle], nw), Weight::owned("b", &[middle], nb), 1e-5);
            layers.push((conv3.unwrap(), dressed.then(|| norm.unwrap()), point.unwrap(), expected));
        }
        let input = HeadInput {
            map: MapRef::new(&x, h, w),
            channels: c,
            size,
            corners: Corners::Aligned,
            embedding: Some(&embedding),
        };
        for compute in all_computes() {
            let mut outs = vec![vec![f32::NAN; size.rows * size.cols * outputs]; 2];
            let mut branches: Vec<HeadBranch<'_>> = layers
                .iter()
                .zip(&mut outs)
                .map(|((conv, norm, point, _), out)| HeadBranch { conv, norm: norm.as_ref(), point, out })
                .collect();
            head(&compute, &input, &mut branches);
            for (out, (_, _, _, expected)) in outs.iter().zip(&layers) {
                let error = error_in_std(out, expected);
                assert!(
                    error < 3.0 * bound(compute.precision()),
                    "{compute:?} {h}x{w} to {size:?}: {error:e}"
                );
            }
        }
    }
    assert!(wide(&[]).is_empty());
}
