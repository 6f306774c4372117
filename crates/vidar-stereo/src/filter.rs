//! Removal of speckles: small connected regions of depth.

/// Regions of fewer pixels are removed; real objects of this size are rarely matched correctly.
const MIN_REGION_PX: usize = 24;
/// Relative inverse-depth difference of adjacent pixels of one region.
const STEP_RATIO: f32 = 0.04;

/// Sets `rho` to NaN on regions of fewer than [`MIN_REGION_PX`] pixels.
pub(crate) fn remove_speckles(rho: &mut [f32], width: usize) {
    let height = rho.len() / width.max(1);
    let mut visited = vec![false; rho.len()];
    let mut island = Vec::new();
    for start in 0..rho.len() {
        if visited[start] || rho[start].is_nan() {
            continue;
        }
        island.clear();
        island.push(start);
        visited[start] = true;
        let mut next = 0;
        while next < island.len() {
            let i = island[next];
            next += 1;
            let (x, y) = (i % width, i / width);
            let around = [
                (x > 0).then(|| i - 1),
                (x + 1 < width).then_some(i + 1),
                (y > 0).then(|| i - width),
                (y + 1 < height).then_some(i + width),
            ];
            for j in around.into_iter().flatten() {
                // A NaN fails the comparison.
                if !visited[j] && (rho[j] - rho[i]).abs() < STEP_RATIO * rho[i] {
                    visited[j] = true;
                    island.push(j);
                }
            }
        }
        if island.len() < MIN_REGION_PX {
            for &i in &island {
                rho[i] = f32::NAN;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_speckle_goes_and_the_surface_around_it_stays() {
        let mut rho = vec![0.5f32; 20 * 10];
        for (x, y) in [(5, 5), (6, 5), (6, 6)] {
            rho[y * 20 + x] = 1.5;
        }
        remove_speckles(&mut rho, 20);
        assert_eq!(rho.iter().filter(|r| r.is_nan()).count(), 3);
        assert!(rho[5 * 20 + 5].is_nan() && rho[0] == 0.5);
    }
}
