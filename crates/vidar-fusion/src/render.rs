//! The surface seen from a camera: z-depth and confidence of the nearest triangle at every pixel.
//!
//! Triangles are scan-converted into a z-buffer of inverse depth, which is linear in the image over a plane. A mesh of
//! marching cubes is ordered by blocks, so runs of triangles lie together in space: a run that a camera cannot see costs
//! one test of its bounding sphere. Casting a ray per pixel through the volume was the alternative; a view holds fewer
//! triangles than a ray has voxels times pixels, and the mesh is what is exported and scored.

use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;
use vidar_core::{Image, LieGroup, Pinhole, Se3, TriangleMesh};

/// Triangles of a run. Smaller runs fit the view more tightly, larger ones need fewer tests.
pub(crate) const RUN: usize = 128;
/// Nearest distance that is seen, metres: closer triangles would cover the image by their rounding errors.
const NEAR_M: f32 = 0.05;
/// A pixel centre this far outside of an edge, as a share of the triangle, still belongs to it: neighbours share their
/// edge exactly but not its rounding, and a gap of one pixel would be a hole in a wall.
const EDGE_SLACK: f32 = 1e-5;

/// Depth of a surface seen from a camera.
#[derive(Clone, Debug, PartialEq)]
pub struct RenderedDepth {
    /// z-depth, metres; NaN where no surface is seen, or only its back.
    pub depth: Image<f32>,
    /// Confidence of the surface there, 0…1; 0 where there is no depth.
    pub confidence: Image<f32>,
}

/// A mesh, prepared for rendering from many cameras.
#[derive(Debug)]
pub struct SurfaceRenderer<'m> {
    mesh: &'m TriangleMesh,
    /// Centre and radius of the sphere around each run of [`RUN`] triangles, metres.
    spheres: Vec<(Vector3<f32>, f32)>,
}

/// A vertex in the image: column, row, inverse depth.
pub(crate) type Projected = [f32; 3];

impl<'m> SurfaceRenderer<'m> {
    /// A renderer of `mesh`, whose triangles are counter-clockwise as seen from their observed side.
    pub fn new(mesh: &'m TriangleMesh) -> Self {
        let spheres = mesh.triangles.par_chunks(RUN).map(|run| sphere(mesh, run)).collect();
        Self { mesh, spheres }
    }

    /// Depth and confidence at the pixels of a camera.
    ///
    /// Where the nearest surface is seen from behind, there is no depth: the camera cannot have looked through it, so what
    /// lies there is unknown. The same bits for any number of threads.
    pub fn render(&self, world_from_camera: &Se3, camera: &Pinhole) -> RenderedDepth {
        let (width, height) = (camera.width, camera.height);
        let raster = self.raster(&Eye::new(world_from_camera, camera), camera);
        let depth = raster.inverse_depth.iter().zip(&raster.confidence);
        let depth = depth.map(|(r, c)| if *r > 0.0 && *c > 0.0 { 1.0 / r } else { f32::NAN }).collect();
        let confidence = raster.confidence.iter().map(|c| c.max(0.0)).collect();
        let empty = || Image::filled(width, height, 0.0);
        RenderedDepth {
            depth: Image::from_vec(width, height, depth).unwrap_or_else(|_| empty()),
            confidence: Image::from_vec(width, height, confidence).unwrap_or_else(|_| empty()),
        }
    }

    /// z-depth of the nearest surface at the pixels of a camera, metres, from whichever side it is seen; infinite where there is none.
    pub(crate) fn nearest(&self, world_from_camera: &Se3, camera: &Pinhole) -> (Image<f32>, Eye) {
        let eye = Eye::new(world_from_camera, camera);
        let depth = self.raster(&eye, camera).inverse_depth.iter().map(|r| 1.0 / r).collect();
        let empty = |_| Image::filled(camera.width, camera.height, f32::INFINITY);
        (Image::from_vec(camera.width, camera.height, depth).unwrap_or_else(empty), eye)
    }

    /// The sphere around each run of [`RUN`] triangles.
    pub(crate) fn spheres(&self) -> &[(Vector3<f32>, f32)] {
        &self.spheres
    }

    fn raster(&self, eye: &Eye, camera: &Pinhole) -> Raster {
        let (width, height) = (camera.width, camera.height);
        let mut raster = Raster {
            width,
            height,
            inverse_depth: vec![0.0; width * height],
            confidence: vec![0.0; width * height],
        };
        for (run, sphere) in self.mesh.triangles.chunks(RUN).zip(&self.spheres) {
            if eye.may_see(sphere) {
                self.draw(run, eye, &mut raster);
            }
        }
        raster
    }

    fn draw(&self, run: &[[u32; 3]], eye: &Eye, raster: &mut Raster) {
        for triangle in run {
            let Some(corners) = self.corners(triangle, eye) else { continue };
            raster.draw(&corners, self.confidence(triangle));
        }
    }

    /// The corners in the image; `None` where one is behind the camera or the index is wrong.
    fn corners(&self, triangle: &[u32; 3], eye: &Eye) -> Option<[Projected; 3]> {
        let mut corners = [[0.0; 3]; 3];
        for (corner, index) in corners.iter_mut().zip(triangle) {
            *corner = eye.project(self.mesh.positions.get(*index as usize)?)?;
        }
        Some(corners)
    }

    /// Mean confidence of the corners, above 0; full where the mesh has none.
    fn confidence(&self, triangle: &[u32; 3]) -> f32 {
        let of = |i: &u32| self.mesh.confidences.get(*i as usize).copied().unwrap_or(1.0);
        (triangle.iter().map(of).sum::<f32>() / 3.0).max(f32::MIN_POSITIVE)
    }
}

fn sphere(mesh: &TriangleMesh, run: &[[u32; 3]]) -> (Vector3<f32>, f32) {
    let points = || {
        let indices = run.iter().flatten();
        indices.filter_map(|i| mesh.positions.get(*i as usize)).map(|p| Vector3::from(*p))
    };
    let Some(first) = points().next() else { return (Vector3::zeros(), 0.0) };
    let (low, high) = points().fold((first, first), |(low, high), p| (low.inf(&p), high.sup(&p)));
    let center = (low + high) * 0.5;
    (center, points().map(|p| (p - center).norm()).fold(0.0, f32::max))
}

/// A camera in single precision; its place is subtracted in double precision.
pub(crate) struct Eye {
    center: Vector3<f64>,
    camera_from_world: Matrix3<f32>,
    k: [f32; 4],
    /// Unit normals of the four sides of what it sees, pointing inwards, in the camera's frame.
    sides: [Vector3<f32>; 4],
}

impl Eye {
    pub fn new(world_from_camera: &Se3, camera: &Pinhole) -> Self {
        let camera_from_world = world_from_camera.inverse();
        let k = [camera.fx, camera.fy, camera.cx, camera.cy];
        let (right, bottom) = (camera.width as f64 - 0.5, camera.height as f64 - 0.5);
        let inward = |n: Vector3<f64>| n.normalize().map(|v| v as f32);
        Self {
            center: world_from_camera.translation,
            camera_from_world: camera_from_world.rotation.matrix().map(|v| v as f32),
            k: k.map(|v| v as f32),
            sides: [
                inward(Vector3::new(k[0], 0.0, k[2] + 0.5)),
                inward(Vector3::new(-k[0], 0.0, right - k[2])),
                inward(Vector3::new(0.0, k[1], k[3] + 0.5)),
                inward(Vector3::new(0.0, -k[1], bottom - k[3])),
            ],
        }
    }

    fn to_camera(&self, p: &[f32; 3]) -> Vector3<f32> {
        let from_center = Vector3::new(
            (f64::from(p[0]) - self.center.x) as f32,
            (f64::from(p[1]) - self.center.y) as f32,
            (f64::from(p[2]) - self.center.z) as f32,
        );
        self.camera_from_world * from_center
    }

    pub fn may_see(&self, (center, radius): &(Vector3<f32>, f32)) -> bool {
        let center = self.to_camera(&(*center).into());
        center.z > NEAR_M - radius && self.sides.iter().all(|side| side.dot(&center) > -radius)
    }

    pub fn project(&self, p: &[f32; 3]) -> Option<Projected> {
        let p = self.to_camera(p);
        // Also false for NaN.
        if !(p.z > NEAR_M) {
            return None;
        }
        let inverse = 1.0 / p.z;
        Some([self.k[0] * p.x * inverse + self.k[2], self.k[1] * p.y * inverse + self.k[3], inverse])
    }
}

/// The nearest surface so far: inverse depth, and its confidence, negative where its back is seen.
struct Raster {
    width: usize,
    height: usize,
    inverse_depth: Vec<f32>,
    confidence: Vec<f32>,
}

impl Raster {
    /// Draws a triangle where it is nearer than what is there.
    fn draw(&mut self, corners: &[Projected; 3], confidence: f32) {
        let [a, b, c] = corners;
        let area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
        let per_area = 1.0 / area;
        if !(area.is_finite() && per_area.is_finite()) {
            return;
        }
        // Rows point down, so a triangle that is counter-clockwise to its observer has a negative area.
        let confidence = if area < 0.0 { confidence } else { -confidence };
        let (columns, rows) = (self.span(corners, 0, self.width), self.span(corners, 1, self.height));
        for row in rows {
            for column in columns.clone() {
                let (x, y) = (column as f32, row as f32);
                let wa = ((b[0] - x) * (c[1] - y) - (b[1] - y) * (c[0] - x)) * per_area;
                let wb = ((c[0] - x) * (a[1] - y) - (c[1] - y) * (a[0] - x)) * per_area;
                let wc = 1.0 - wa - wb;
                if wa < -EDGE_SLACK || wb < -EDGE_SLACK || wc < -EDGE_SLACK {
                    continue;
                }
                let inverse = wa * a[2] + wb * b[2] + wc * c[2];
                let at = row * self.width + column;
                if inverse > self.inverse_depth[at] {
                    self.inverse_depth[at] = inverse;
                    self.confidence[at] = confidence;
                }
            }
        }
    }

    /// The pixels along an axis whose centres a triangle may cover.
    fn span(&self, corners: &[Projected; 3], axis: usize, size: usize) -> std::ops::Range<usize> {
        let values = corners.map(|c| c[axis]);
        let low = values.iter().copied().fold(f32::INFINITY, f32::min).ceil().max(0.0);
        let high = values.iter().copied().fold(f32::NEG_INFINITY, f32::max).floor().min(size as f32 - 1.0);
        // Neither is NaN, and `as` saturates.
        if high < low { 0..0 } else { low as usize..high as usize + 1 }
    }
}

#[cfg(test)]
mod tests;
