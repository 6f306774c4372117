//! Darkens creases and surfaces behind edges, which a light at the camera does not show.
//!
//! A pixel that is deeper than the mean of two opposite neighbours is in a hollow. Inverse depth is linear over a
//! plane, so planes are not changed at any viewing angle. After the idea of eye-dome lighting (Boucheny 2009).

use super::raster::{Lens, Rasterised};
use crate::Picture;
use rayon::prelude::*;

/// Half the distance of opposite neighbours, as a share of the picture's height.
const RADII: [f64; 2] = [0.002, 0.006];
/// Depth of a hollow, in units of the neighbours' distance, that is darkened fully.
const FULL_DEPTH: f32 = 1.5;
/// Share of light taken from the deepest hollow.
const STRENGTH: f32 = 0.5;

pub(super) fn darkened(frame: Rasterised, lens: &Lens) -> Picture {
    let (width, height) = (frame.width, frame.height);
    let mut colors = frame.colors;
    let nearness = &frame.nearness;
    colors.par_chunks_mut(width).enumerate().for_each(|(y, row)| {
        for (x, color) in row.iter_mut().enumerate() {
            let here = nearness[y * width + x];
            if here == f32::NEG_INFINITY {
                continue;
            }
            let hollow = hollow_at(nearness, (width, height), (x, y), here, lens);
            let light = 1.0 - STRENGTH * hollow;
            *color = color.map(|c| (f32::from(c) * light).round() as u8);
        }
    });
    Picture::from_fn(width, height, |x, y| colors[y * width + x])
}

/// How much of a hollow a pixel lies in, 0…1: the mean over directions and radii.
fn hollow_at(
    nearness: &[f32],
    (width, height): (usize, usize),
    (x, y): (usize, usize),
    here: f32,
    lens: &Lens,
) -> f32 {
    let at = |dx: i64, dy: i64| {
        let (x, y) = (x as i64 + dx, y as i64 + dy);
        let inside = x >= 0 && y >= 0 && x < width as i64 && y < height as i64;
        let value = if inside { nearness[y as usize * width + x as usize] } else { here };
        // Background behind an outline is not a hollow.
        if value == f32::NEG_INFINITY { here } else { value }
    };
    let mut sum = 0.0;
    for share in RADII {
        let r = ((share * height as f64).round() as i64).max(1);
        for (dx, dy) in [(r, 0), (0, r), (r, r), (r, -r)] {
            let above = 0.5 * (at(dx, dy) + at(-dx, -dy)) - here;
            if above > 0.0 {
                let reach = lens.pixel_m(here) * r as f32;
                sum += (lens.depth_difference_m(here, above) / (reach * FULL_DEPTH)).min(1.0);
            }
        }
    }
    sum / (4 * RADII.len()) as f32
}
