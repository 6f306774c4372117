//! Cells of space: thinning of clouds, normals of points without, values carried from samples to vertices.

use nalgebra::{Matrix3, SymmetricEigen, Vector3};
use std::collections::HashMap;
use vidar_core::PointCloud;

/// A cell of a regular grid.
pub(super) type Cell = [i32; 3];

/// Attempts to find the cell that leaves the wanted number; each comes closer by the square root of the ratio.
pub(super) const ATTEMPTS: usize = 8;
/// A result with this share of the wanted number is near enough.
pub(super) const NEAR_ENOUGH: f64 = 0.85;

/// The cell of a point; `None` for one that is not finite or too far out for 32 bits.
pub(super) fn cell_of(p: &[f32; 3], side_m: f64) -> Option<Cell> {
    let at = p.map(|v| (f64::from(v) / side_m).floor());
    at.iter().all(|v| v.abs() < f64::from(i32::MAX)).then(|| at.map(|v| v as i32))
}

/// Largest extent along an axis of the finite points, metres.
pub(super) fn extent(points: &[[f32; 3]]) -> f64 {
    let (mut low, mut high) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);
    for p in points.iter().filter(|p| p.iter().all(|v| v.is_finite())) {
        for axis in 0..3 {
            low[axis] = low[axis].min(p[axis]);
            high[axis] = high[axis].max(p[axis]);
        }
    }
    (0..3).map(|axis| f64::from(high[axis]) - f64::from(low[axis])).fold(0.0, f64::max)
}

/// At most `most` points of a cloud, one per cell, with the spacing that this leaves (metres). Points stay where they were
/// measured: nothing is averaged.
pub(super) fn thinned(cloud: &PointCloud, most: usize) -> (PointCloud, f64) {
    let finite: Vec<usize> =
        (0..cloud.len()).filter(|&i| cloud.positions[i].iter().all(|v| v.is_finite())).collect();
    // A surface fills the square of extent / side; twice that is a start that the attempts correct.
    let mut side = (extent(&cloud.positions) / (most.max(1) as f64 / 6.0).sqrt()).max(1e-6);
    let mut best: Vec<usize> = Vec::new();
    let mut best_side = side;
    for _ in 0..ATTEMPTS {
        let mut taken = HashMap::<Cell, ()>::with_capacity(most);
        let kept: Vec<usize> = finite
            .iter()
            .copied()
            .filter(|&i| {
                cell_of(&cloud.positions[i], side).is_some_and(|cell| taken.insert(cell, ()).is_none())
            })
            .collect();
        let count = kept.len();
        if count <= most && count > best.len() {
            (best, best_side) = (kept, side);
        }
        let share = count as f64 / most.max(1) as f64;
        // Smaller cells cannot keep more than all points.
        if (NEAR_ENOUGH..=1.0).contains(&share) || count == finite.len() && share <= 1.0 {
            break;
        }
        // A little less than wanted, so that the limit itself is not met from above for ever.
        side *= (share / 0.93).sqrt().clamp(0.1, 10.0);
    }
    let take3 = |list: &Vec<[f32; 3]>| best.iter().filter_map(|&i| list.get(i).copied()).collect();
    let kept = PointCloud {
        positions: take3(&cloud.positions),
        normals: take3(&cloud.normals),
        colors: best.iter().filter_map(|&i| cloud.colors.get(i).copied()).collect(),
        confidences: best.iter().filter_map(|&i| cloud.confidences.get(i).copied()).collect(),
    };
    (kept, best_side)
}

/// Count, sum and sum of products of the points in a cell, relative to the cell's corner for accuracy.
#[derive(Clone, Copy)]
struct Moments {
    count: f64,
    sum: Vector3<f64>,
    products: Matrix3<f64>,
}

/// Normals of `places` from the scatter of `all` points around them, turned towards the nearest of `eyes`; zero where the
/// points around do not form a surface. `spacing_m` is the distance of neighbours in `places`.
pub(super) fn normals_towards(
    places: &[[f32; 3]],
    all: &[[f32; 3]],
    spacing_m: f64,
    eyes: &[Vector3<f64>],
) -> Vec<[f32; 3]> {
    let mut cells = HashMap::<Cell, Moments>::new();
    for p in all {
        let Some(cell) = cell_of(p, spacing_m) else { continue };
        let v = Vector3::from(p.map(f64::from)) - corner(&cell, spacing_m);
        let m = cells.entry(cell).or_insert(Moments {
            count: 0.0,
            sum: Vector3::zeros(),
            products: Matrix3::zeros(),
        });
        m.count += 1.0;
        m.sum += v;
        m.products += v * v.transpose();
    }
    places.iter().map(|p| normal_at(p, &cells, spacing_m, eyes).unwrap_or_default()).collect()
}

fn corner(cell: &Cell, side_m: f64) -> Vector3<f64> {
    Vector3::from(cell.map(|c| f64::from(c) * side_m))
}

fn normal_at(
    p: &[f32; 3],
    cells: &HashMap<Cell, Moments>,
    side_m: f64,
    eyes: &[Vector3<f64>],
) -> Option<[f32; 3]> {
    let center = cell_of(p, side_m)?;
    let place = Vector3::from(p.map(f64::from));
    let (mut count, mut sum, mut products) = (0.0, Vector3::zeros(), Matrix3::zeros());
    for neighbour in around(&center) {
        let Some(m) = cells.get(&neighbour) else { continue };
        // The moments move from the cell's corner to the place.
        let shift = corner(&neighbour, side_m) - place;
        count += m.count;
        sum += m.sum + shift * m.count;
        products += m.products
            + m.sum * shift.transpose()
            + shift * m.sum.transpose()
            + shift * shift.transpose() * m.count;
    }
    // Three points always lie in a plane; a few more make it one that was measured.
    if count < 6.0 {
        return None;
    }
    let mean = sum / count;
    let eigen = SymmetricEigen::new(products / count - mean * mean.transpose());
    let normal: Vector3<f64> = eigen.eigenvectors.column(eigen.eigenvalues.imin()).into();
    let distance = |eye: &&Vector3<f64>| (*eye - place).norm_squared();
    let eye = eyes.iter().min_by(|a, b| distance(a).total_cmp(&distance(b)))?;
    let towards = if normal.dot(&(eye - place)) < 0.0 { -normal } else { normal };
    towards.iter().all(|v| v.is_finite()).then(|| [towards.x as f32, towards.y as f32, towards.z as f32])
}

fn around(center: &Cell) -> impl Iterator<Item = Cell> + use<> {
    let [x, y, z] = *center;
    (-1..=1).flat_map(move |dx| {
        (-1..=1).flat_map(move |dy| {
            (-1..=1).map(move |dz| [x.saturating_add(dx), y.saturating_add(dy), z.saturating_add(dz)])
        })
    })
}

/// Means of samples by cell, to be looked up at other places.
pub(super) struct SampleMeans {
    side_m: f64,
    cells: HashMap<Cell, (f64, f64)>,
}

impl SampleMeans {
    /// Of the finite values at finite positions, in cells of `side_m` metres.
    pub(super) fn new(positions: &[[f32; 3]], values: &[f32], side_m: f64) -> Self {
        let mut cells = HashMap::<Cell, (f64, f64)>::new();
        for (p, &value) in positions.iter().zip(values).filter(|(_, v)| v.is_finite()) {
            if let Some(cell) = cell_of(p, side_m) {
                let mean = cells.entry(cell).or_default();
                mean.0 += f64::from(value);
                mean.1 += 1.0;
            }
        }
        Self { side_m, cells }
    }

    /// The mean in the cell of `p`, else in the cells around it, else NaN.
    pub(super) fn at(&self, p: &[f32; 3]) -> f32 {
        let Some(cell) = cell_of(p, self.side_m) else { return f32::NAN };
        let found = self.cells.get(&cell).copied().unwrap_or_else(|| {
            let near = around(&cell).filter_map(|c| self.cells.get(&c));
            near.fold((0.0, 0.0), |(sum, count), (s, n)| (sum + s, count + n))
        });
        if found.1 > 0.0 { (found.0 / found.1) as f32 } else { f32::NAN }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn floor(n: usize) -> PointCloud {
        let at = |i: usize| [(i % n) as f32 * 0.01, (i / n) as f32 * 0.01, 0.0];
        PointCloud::from_positions((0..n * n).map(at).collect())
    }

    #[test]
    fn a_thinned_cloud_is_near_its_limit_and_keeps_measured_points() {
        let cloud = floor(200);
        let (kept, spacing) = thinned(&cloud, 5_000);
        assert!((4_000..=5_000).contains(&kept.len()), "{}", kept.len());
        assert!(kept.positions.iter().all(|p| cloud.positions.contains(p)));
        assert!((0.02..0.05).contains(&spacing), "{spacing}");
        // A cloud below its limit stays as it is, but for points that share a place.
        assert_eq!(thinned(&floor(20), 5_000).0.len(), 400);
    }

    #[test]
    fn normals_of_a_floor_point_at_the_camera_above_it() {
        let cloud = floor(50);
        for (height, up) in [(1.0, 1.0), (-1.0, -1.0)] {
            let eyes = [Vector3::new(0.2, 0.2, height)];
            let normals = normals_towards(&cloud.positions, &cloud.positions, 0.03, &eyes);
            assert!(normals.iter().all(|n| (n[2] - up).abs() < 1e-6), "{height}");
        }
        let line: Vec<[f32; 3]> = vec![[0.0; 3], [1.0, 0.0, 0.0]];
        assert_eq!(normals_towards(&line, &line, 0.1, &[Vector3::zeros()]), [[0.0; 3]; 2]);
    }

    #[test]
    fn samples_are_averaged_in_their_cell_and_unknown_far_away() {
        let positions = [[0.01, 0.0, 0.0], [0.02, 0.0, 0.0], [5.0, 0.0, 0.0]];
        let means = SampleMeans::new(&positions, &[1.0, 3.0, f32::NAN], 0.1);
        assert_eq!(means.at(&[0.05, 0.05, 0.05]), 2.0);
        assert_eq!(means.at(&[0.15, 0.05, 0.05]), 2.0);
        assert!(means.at(&[5.0, 0.0, 0.0]).is_nan() && means.at(&[f32::NAN; 3]).is_nan());
    }
}
