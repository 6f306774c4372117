//! Untextured regions: connected parts of the image in which brightness hardly changes from pixel to pixel.

use vidar_core::Image;

/// Largest difference between pixels two apart in the smoothed image, grey levels, that is no texture. Above the noise of
/// consumer cameras after smoothing (1 to 2 levels), below what stereo matches.
const MAX_STEP: f32 = 5.0;
/// How far a region reaches beyond its own pixels to find measured depth, pixels: stereo's windows are 5 wide and see texture
/// within 2 pixels; edges are smoothed over 2 more.
const REACH: usize = 6;
/// Smaller regions are not worth a plane.
const LEAST_PIXELS: usize = 200;
/// A region's number where there is none.
const NOWHERE: u32 = u32::MAX;

/// Grey levels of a colour image (Rec. 601); all alike where there is none.
pub(super) fn luminance(color: Option<&Image<[u8; 3]>>, width: usize, height: usize) -> Vec<f32> {
    let level = |[r, g, b]: &[u8; 3]| 0.299 * f32::from(*r) + 0.587 * f32::from(*g) + 0.114 * f32::from(*b);
    color.map_or_else(|| vec![0.0; width * height], |c| c.data().iter().map(level).collect())
}

/// Pixels by region.
pub(super) struct Regions {
    pub width: usize,
    /// Pixels of each region with those within [`REACH`] of it, and whether they are its own; ascending.
    pub members: Vec<Vec<(u32, bool)>>,
}

impl Regions {
    /// The regions of an image.
    pub fn of(luminance: &[f32], width: usize, height: usize) -> Self {
        let smooth = smoothed(luminance, width, height);
        let (mut of, count) = connected(&flat(&smooth, width, height), width);
        let own = of.clone();
        grow(&mut of, width);
        let mut members = vec![Vec::new(); count];
        for (i, region) in of.iter().enumerate().filter(|(_, region)| **region != NOWHERE) {
            members[*region as usize].push((i as u32, own[i] == *region));
        }
        Self { width, members }
    }
}

/// Mean over 3 x 3 pixels.
fn smoothed(values: &[f32], width: usize, height: usize) -> Vec<f32> {
    let mean = |before: f32, own: f32, after: f32| (before + own + after) / 3.0;
    let mut across = values.to_vec();
    for (out, row) in across.chunks_exact_mut(width).zip(values.chunks_exact(width)) {
        for x in 0..width {
            out[x] = mean(row[x.saturating_sub(1)], row[x], row[(x + 1).min(width - 1)]);
        }
    }
    let mut smooth = across.clone();
    for (y, out) in smooth.chunks_exact_mut(width).enumerate() {
        let [above, own, below] = rows_around(&across, width, height, y);
        for x in 0..width {
            out[x] = mean(above[x], own[x], below[x]);
        }
    }
    smooth
}

/// Where brightness hardly changes.
fn flat(smooth: &[f32], width: usize, height: usize) -> Vec<bool> {
    let mut is_flat = vec![false; width * height];
    for (y, out) in is_flat.chunks_exact_mut(width).enumerate() {
        let [above, own, below] = rows_around(smooth, width, height, y);
        for x in 0..width {
            let across = own[(x + 1).min(width - 1)] - own[x.saturating_sub(1)];
            out[x] = across.abs().max((below[x] - above[x]).abs()) <= MAX_STEP;
        }
    }
    is_flat
}

/// The row above, the row itself and the one below; the first and the last row are beside themselves.
fn rows_around(values: &[f32], width: usize, height: usize, y: usize) -> [&[f32]; 3] {
    [y.saturating_sub(1), y, (y + 1).min(height - 1)].map(|y| &values[y * width..][..width])
}

/// Numbers of the connected parts of `inside` with enough pixels, by their first pixel, and how many there are.
fn connected(inside: &[bool], width: usize) -> (Vec<u32>, usize) {
    let mut of = vec![NOWHERE; inside.len()];
    let mut seen = vec![false; inside.len()];
    let (mut count, mut part) = (0, Vec::new());
    for first in 0..inside.len() {
        if !inside[first] || seen[first] {
            continue;
        }
        part.clear();
        part.push(first);
        seen[first] = true;
        let mut next = 0;
        while let Some(&i) = part.get(next) {
            next += 1;
            for j in neighbours(i, width, inside.len()) {
                if inside[j] && !seen[j] {
                    seen[j] = true;
                    part.push(j);
                }
            }
        }
        if part.len() >= LEAST_PIXELS {
            part.iter().for_each(|i| of[*i] = count);
            count += 1;
        }
    }
    (of, count as usize)
}

/// [`REACH`] times every region takes the free pixels beside it; of several the one with the lowest number.
fn grow(of: &mut [u32], width: usize) {
    let taken = (0..of.len()).filter(|i| of[*i] != NOWHERE);
    let mut last: Vec<(usize, u32)> = taken.map(|i| (i, of[i])).collect();
    for _ in 0..REACH {
        // A pixel that was free beside one of an earlier round would have been taken then.
        let beside = |&(i, region): &(usize, u32)| neighbours(i, width, of.len()).map(move |j| (j, region));
        let mut next: Vec<(usize, u32)> =
            last.iter().flat_map(beside).filter(|(j, _)| of[*j] == NOWHERE).collect();
        for (j, region) in &next {
            of[*j] = of[*j].min(*region);
        }
        next.iter_mut().for_each(|(j, region)| *region = of[*j]);
        last = next;
    }
}

fn neighbours(i: usize, width: usize, size: usize) -> impl Iterator<Item = usize> {
    let x = i % width;
    let left = (x > 0).then(|| i - 1);
    let right = (x + 1 < width).then_some(i + 1);
    let up = i.checked_sub(width);
    let down = (i + width < size).then_some(i + width);
    [left, right, up, down].into_iter().flatten()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn regions_grow_as_by_the_definition() {
        let (width, height) = (37, 23);
        let seed = |i: usize| if i * 7919 % 41 < 2 { (i % 5) as u32 } else { NOWHERE };
        let mut grown: Vec<u32> = (0..width * height).map(seed).collect();
        let mut expected = grown.clone();
        for _ in 0..REACH {
            let before = expected.clone();
            for (i, region) in expected.iter_mut().enumerate().filter(|(_, region)| **region == NOWHERE) {
                *region = neighbours(i, width, before.len()).map(|j| before[j]).min().unwrap_or(NOWHERE);
            }
        }
        grow(&mut grown, width);
        assert_eq!(grown, expected);
        // Sparse seeds, so that regions also end where nothing is beside them.
        assert!(expected.contains(&0) && expected.contains(&4));
    }

    #[test]
    fn a_wall_and_a_floor_are_two_regions_and_texture_is_none() {
        // A wall above, a darker floor below, texture on the right.
        let (width, height) = (80, 60);
        let level = |x: usize, y: usize| match (x < 60, y < 30) {
            (true, true) => 200.0,
            (true, false) => 90.0,
            (false, _) => ((x * 7919 + y * 104_729) % 251) as f32,
        };
        let luminance: Vec<f32> = (0..width * height).map(|i| level(i % width, i / width)).collect();
        let regions = Regions::of(&luminance, width, height);
        assert_eq!(regions.members.len(), 2);
        let own = |r: usize| regions.members[r].iter().filter(|m| m.1).map(|m| m.0 as usize);
        assert!(own(0).all(|i| i / width < 30 && i % width < 60) && own(0).count() > 57 * 26);
        assert!(own(1).all(|i| i / width >= 30 && i % width < 60) && own(1).count() > 57 * 26);
        // Beyond its pixels a region reaches into the texture.
        assert!(regions.members[0].iter().any(|(i, own)| !own && *i as usize % width >= 62));
    }
}
