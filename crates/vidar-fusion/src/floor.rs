//! What is seen through the floor: a shiny floor mirrors windows, lamps and walls, and stereo finds them as far below it as they are above, in
//! every view alike. No surface is seen through another one, so pixels whose rays pass the floor are no measurements of depth.

use nalgebra::{Vector2, Vector3};
use rustc_hash::FxHashSet;
use vidar_core::{AlignedView, Image, TriangleMesh};

/// Heights are counted in steps of this, m: the roughness of a fused floor.
const STEP_M: f64 = 0.05;
/// Least z of the normal of a horizontal surface.
const LEVEL: f32 = 0.8;
/// Size of the cells that say where the floor is, m, and the gap between them that counts as floor, cells to each side: what is mirrored hides the floor there.
const CELL_M: f64 = 0.1;
const GAP_CELLS: i32 = 3;
/// Smallest floor, cells (a square metre).
const LEAST_CELLS: usize = 100;
/// Cameras that are less than this above a surface do not look down on it, m; this share of them has to.
const LEAST_HEIGHT_M: f64 = 0.3;
const LEAST_SHARE: f64 = 0.8;
/// What lies this far below the floor, m, or this share of its distance, is below it: stereo's error.
const BELOW_M: f64 = 0.15;
const BELOW_SHARE: f64 = 0.05;

/// The largest horizontal surface of a world with z up, which the cameras look down on.
#[derive(Clone, Debug)]
pub struct Floor {
    height_m: f64,
    cells: FxHashSet<[i32; 2]>,
}

impl Floor {
    /// The floor of a fused surface with normals, seen by cameras at `centres`; `None` where there is none.
    pub fn of_mesh(mesh: &TriangleMesh, centres: &[Vector3<f64>]) -> Option<Self> {
        let level = mesh.positions.iter().zip(&mesh.normals).filter(|(_, n)| n[2] > LEVEL).map(|(p, _)| p);
        let step = |p: &[f32; 3]| (f64::from(p[2]) / STEP_M).floor() as i64;
        let mut steps: Vec<i64> = level.clone().map(step).collect();
        steps.sort_unstable();
        // The height around which most vertices lie: they are as dense everywhere. Of equals the lowest.
        let most =
            steps.chunk_by(|a, b| a == b).max_by(|a, b| a.len().cmp(&b.len()).then(b[0].cmp(&a[0])))?[0];
        let floor: Vec<&[f32; 3]> = level.filter(|p| (step(p) - most).abs() <= 1).collect();
        let height_m = floor.iter().map(|p| f64::from(p[2])).sum::<f64>() / floor.len() as f64;
        let above = centres.iter().filter(|c| c.z > height_m + LEAST_HEIGHT_M).count();
        if (above as f64) < LEAST_SHARE * centres.len() as f64 {
            return None;
        }
        let shown: FxHashSet<[i32; 2]> =
            floor.iter().map(|p| cell(&Vector2::new(f64::from(p[0]), f64::from(p[1])))).collect();
        // Gaps are closed, and the outermost cells are left out: a ray past the edge of the floor is none through it.
        let cells = shrunk(&grown(&shown, GAP_CELLS), GAP_CELLS + 1);
        (cells.len() >= LEAST_CELLS).then_some(Self { height_m, cells })
    }

    /// Share of the surface's vertices that lies below the floor.
    pub fn share_below(&self, mesh: &TriangleMesh) -> f64 {
        let below = mesh.positions.iter().filter(|p| f64::from(p[2]) < self.height_m - BELOW_M).count();
        below as f64 / mesh.positions.len().max(1) as f64
    }

    /// The pixels of a view that show something through the floor (`true`); `None` where none does.
    pub fn seen_through(&self, view: &AlignedView) -> Option<Image<bool>> {
        let (k, camera) = (view.intrinsics(), view.world_from_camera());
        let centre = camera.translation;
        let above = centre.z - self.height_m;
        if above < LEAST_HEIGHT_M {
            return None;
        }
        let rotation = camera.rotation.matrix();
        let depth = view.depth().image();
        let is_through = |x: usize, y: usize| {
            let z = f64::from(depth[(x, y)]);
            let along = rotation * k.ray(x as f64, y as f64);
            let drop = -along.z * z;
            let limit = above + BELOW_M.max(BELOW_SHARE * z);
            // Not where there is no depth: NaN is not below.
            drop > limit && self.cells.contains(&cell(&(centre + along * (above / -along.z)).xy()))
        };
        let mask = Image::from_fn(k.width, k.height, is_through);
        mask.data().iter().any(|m| *m).then_some(mask)
    }
}

fn cell(at: &Vector2<f64>) -> [i32; 2] {
    [at.x, at.y].map(|c| (c / CELL_M).floor() as i32)
}

/// All cells within a square around those given.
fn grown(cells: &FxHashSet<[i32; 2]>, by: i32) -> FxHashSet<[i32; 2]> {
    let around = move |c: &[i32; 2]| {
        let [x, y] = *c;
        (-by..=by).flat_map(move |dy| (-by..=by).map(move |dx| [x.saturating_add(dx), y.saturating_add(dy)]))
    };
    cells.iter().flat_map(around).collect()
}

/// The cells whose square is all among those given.
fn shrunk(cells: &FxHashSet<[i32; 2]>, by: i32) -> FxHashSet<[i32; 2]> {
    let is_inside = |c: &&[i32; 2]| {
        let [x, y] = **c;
        let has = |dx: i32, dy: i32| cells.contains(&[x.saturating_add(dx), y.saturating_add(dy)]);
        (-by..=by).all(|dy| (-by..=by).all(|dx| has(dx, dy)))
    };
    cells.iter().filter(is_inside).copied().collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Matrix3;
    use vidar_core::{Confidence, FrameId, MetricDepth, Pinhole, Se3, So3, Timestamp};

    /// A floor of 4 by 4 m at z = −1.2 without its quarter of positive x and y, a table above it, and a camera that looks down.
    fn room() -> TriangleMesh {
        let mut mesh = TriangleMesh::default();
        let mut add = |x: f32, y: f32, z: f32, normal: [f32; 3]| {
            mesh.positions.push([x, y, z]);
            mesh.normals.push(normal);
        };
        for i in 0..100 {
            for j in 0..100 {
                let (x, y) = (i as f32 * 0.04 - 2.0, j as f32 * 0.04 - 2.0);
                if x < 0.0 || y < 0.0 {
                    add(x, y, -1.2 + 0.01 * ((i + j) % 3) as f32, [0.0, 0.0, 1.0]);
                }
                if i < 30 && j < 30 {
                    add(x, y, -0.5, [0.0, 0.0, 1.0]);
                    add(x, y, 1.0, [0.0, 0.0, -1.0]);
                }
            }
        }
        mesh
    }

    /// A camera at the origin that looks straight down, x to the right; `depth` of its pixels.
    fn view(depth: impl FnMut(usize, usize) -> f32) -> AlignedView {
        let k = Pinhole::new(20.0, 20.0, 19.5, 19.5, 40, 40).unwrap();
        let down = Matrix3::from_columns(&[Vector3::x(), -Vector3::y(), -Vector3::z()]);
        let pose = Se3::new(So3::from_matrix(&down).unwrap(), Vector3::zeros());
        let depth = MetricDepth::new(Image::from_fn(40, 40, depth));
        let time = Timestamp::from_nanos(0);
        AlignedView::new(FrameId(0), time, pose, k, depth, Confidence::full(40, 40)).unwrap()
    }

    #[test]
    fn what_is_mirrored_in_the_floor_is_seen_through_it_and_what_lies_past_its_edge_is_not() {
        let centres = [Vector3::zeros(); 3];
        let floor = Floor::of_mesh(&room(), &centres).unwrap();
        assert!((floor.height_m + 1.19).abs() < 0.01, "{}", floor.height_m);
        // Everything a window's mirror image at 3 m: through the floor but for the quarter without it (right, and up in the image).
        let mask = floor.seen_through(&view(|_, _| 3.0)).unwrap();
        assert!(mask[(5, 5)] && mask[(5, 35)] && mask[(35, 35)]);
        assert!(!mask[(30, 10)] && !mask[(24, 16)]);
        // The floor itself, with an error of stereo, what stands on it, and what has no depth.
        assert!(floor.seen_through(&view(|_, _| 1.3)).is_none());
        assert!(floor.seen_through(&view(|_, _| 0.7)).is_none());
        assert!(floor.seen_through(&view(|_, _| f32::NAN)).is_none());
    }

    #[test]
    fn a_gap_in_the_floor_that_is_small_counts_as_floor() {
        let mut mesh = room();
        let is_gap = |p: &[f32; 3]| (p[0] + 1.0).abs() < 0.25 && (p[1] + 1.0).abs() < 0.25;
        let kept: Vec<usize> = (0..mesh.positions.len()).filter(|i| !is_gap(&mesh.positions[*i])).collect();
        mesh.positions = kept.iter().map(|i| mesh.positions[*i]).collect();
        mesh.normals = kept.iter().map(|i| mesh.normals[*i]).collect();
        let floor = Floor::of_mesh(&mesh, &[Vector3::zeros()]).unwrap();
        assert!(floor.cells.contains(&[-10, -10]));
    }

    #[test]
    fn a_surface_that_the_cameras_are_not_above_is_no_floor() {
        assert!(Floor::of_mesh(&room(), &[Vector3::new(0.0, 0.0, -1.1)]).is_none());
        assert!(Floor::of_mesh(&TriangleMesh::default(), &[Vector3::zeros()]).is_none());
    }
}
