//! Scan conversion of triangles and discs into a z-buffer, band by band.

mod band;

use super::camera::{BackFaces, MapCamera, Projection};
use crate::ViewError;
use band::Band;
use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;

/// Samples per pixel along each side.
const SAMPLES: usize = 3;
/// Rows of the picture that are drawn together; a band's samples fit the cache.
const BAND_ROWS: usize = 16;
/// Nearest distance a perspective camera sees, metres.
const NEAR_M: f32 = 0.05;
/// Sub-sample positions per sample: vertices are rounded to these, and edges are exact from there on.
const SUBSAMPLE: f64 = 256.0;
/// Triangles that reach further than this from the picture's corner, in samples, are left out: the integer edge
/// functions stay within 64 bits.
const REACH: f64 = 4_000_000.0;

/// A vertex in the camera's frame with its lit colour (sRGB, 0…255).
#[derive(Clone, Copy, Debug)]
pub(super) struct Vertex {
    pub place: [f32; 3],
    pub color: [f32; 3],
}

impl Vertex {
    pub(super) fn hidden() -> Self {
        Self { place: [f32::NAN; 3], color: [0.0; 3] }
    }

    fn is_hidden(&self) -> bool {
        self.place[0].is_nan()
    }

    fn between(&self, other: &Self, share: f32) -> Self {
        let mix = |a: [f32; 3], b: [f32; 3]| std::array::from_fn(|i| a[i] + share * (b[i] - a[i]));
        Self { place: mix(self.place, other.place), color: mix(self.color, other.color) }
    }
}

/// A drawn picture before annotation.
pub(super) struct Rasterised {
    pub width: usize,
    pub height: usize,
    pub colors: Vec<[u8; 3]>,
    /// Nearness of the nearest sample per pixel: 1/z in perspective, −z in parallel projection, −∞ for none.
    /// Both are linear in the picture over a plane.
    pub nearness: Vec<f32>,
}

/// A camera fitted to a picture.
pub(super) struct Lens {
    position: Vector3<f64>,
    /// Rows: right, down, forward.
    camera_from_world: Matrix3<f64>,
    width: usize,
    height: usize,
    /// Pixels of the picture per unit of x/z (perspective) or per metre (parallel).
    focal: f64,
    is_perspective: bool,
    back_faces: BackFaces,
}

impl Lens {
    pub(super) fn new(camera: &MapCamera, width: usize, height: usize) -> Result<Self, ViewError> {
        let bad = |what| ViewError::BadCamera { name: camera.name.clone(), what };
        let forward = camera.forward();
        let rows = [camera.right, camera.down, forward];
        if camera.position.iter().chain(rows.iter().flatten()).any(|v| !v.is_finite()) {
            return Err(bad("its position or direction is not finite"));
        }
        if rows.iter().any(|r| (r.norm() - 1.0).abs() > 1e-6) {
            return Err(bad("right and down must be unit vectors at a right angle"));
        }
        let (focal, is_perspective) = match camera.projection {
            Projection::Orthographic { height_m } => (height as f64 / height_m, false),
            Projection::Perspective { vertical_angle_deg: angle } if (1.0..=170.0).contains(&angle) => {
                (0.5 * height as f64 / (0.5 * angle).to_radians().tan(), true)
            }
            Projection::Perspective { .. } => return Err(bad("its angle is not within 1 to 170 degrees")),
        };
        if !(focal.is_finite() && focal > 0.0) {
            return Err(bad("the height it shows is not finite and positive"));
        }
        Ok(Self {
            position: camera.position,
            camera_from_world: Matrix3::from_rows(&rows.map(|r| r.transpose())),
            width,
            height,
            focal,
            is_perspective,
            back_faces: camera.back_faces,
        })
    }

    pub(super) fn culls(&self) -> bool {
        self.back_faces == BackFaces::Cull
    }

    pub(super) fn to_camera(&self, p: &Vector3<f64>) -> [f32; 3] {
        let q = self.camera_from_world * (p - self.position);
        [q.x as f32, q.y as f32, q.z as f32]
    }

    /// Unit direction from a point of the world to the eye.
    pub(super) fn towards_eye(&self, p: &Vector3<f64>) -> Vector3<f64> {
        let forward = self.camera_from_world.row(2).transpose();
        if self.is_perspective {
            (self.position - p).try_normalize(1e-9).unwrap_or(-forward)
        } else {
            -forward
        }
    }

    /// Size of a pixel at a nearness, metres.
    pub(super) fn pixel_m(&self, nearness: f32) -> f32 {
        if self.is_perspective { 1.0 / (nearness * self.focal as f32) } else { 1.0 / self.focal as f32 }
    }

    /// Difference of depth, metres, that a small difference of nearness means.
    pub(super) fn depth_difference_m(&self, nearness: f32, difference: f32) -> f32 {
        if self.is_perspective { difference / (nearness * nearness) } else { difference }
    }

    /// Where a point of the world lies in the picture (corner convention), if in front of the eye.
    pub(super) fn picture_point(&self, p: &Vector3<f64>) -> Option<(f64, f64)> {
        let q = self.to_camera(p);
        if self.is_perspective && q[2] < NEAR_M {
            return None;
        }
        let (x, y, _) = self.sample_point(&q);
        let (x, y) = (x / SAMPLES as f64, y / SAMPLES as f64);
        (x.abs() < 1e6 && y.abs() < 1e6).then_some((x, y))
    }

    /// Sample coordinates and nearness of a place in the camera's frame, which must be in front of it.
    fn sample_point(&self, place: &[f32; 3]) -> (f64, f64, f32) {
        let [x, y, z] = place.map(f64::from);
        let (k, nearness) = if self.is_perspective { (self.focal / z, 1.0 / z) } else { (self.focal, -z) };
        let s = SAMPLES as f64;
        let column = s * (0.5 * self.width as f64 + k * x);
        let row = s * (0.5 * self.height as f64 + k * y);
        (column, row, nearness as f32)
    }

    /// Whether the triangle's counter-clockwise side faces away.
    fn is_back(&self, [a, b, c]: [&Vertex; 3]) -> bool {
        let [a, b, c] = [a, b, c].map(|v| Vector3::from(v.place.map(f64::from)));
        let normal = (b - a).cross(&(c - a));
        let towards_eye = if self.is_perspective { -a } else { -Vector3::z() };
        normal.dot(&towards_eye) <= 0.0
    }

    fn is_before_near(&self, v: &Vertex) -> bool {
        self.is_perspective && !(v.place[2] >= NEAR_M)
    }
}

/// Draws a mesh. `triangles` must name vertices that exist.
pub(super) fn draw_mesh(lens: &Lens, vertices: &[Vertex], triangles: &[[u32; 3]]) -> Rasterised {
    let corners = |t: u32| triangles[t as usize].map(|i| &vertices[i as usize]);
    let bins = binned(lens, triangles.len(), |t, rows| {
        let corners = corners(t);
        if corners.iter().any(|v| v.is_hidden()) || (lens.culls() && lens.is_back(corners)) {
            return;
        }
        for_each_clipped(lens, corners, |part| {
            let points = part.map(|v| lens.sample_point(&v.place));
            let span = |f: fn(&(f64, f64, f32)) -> f64| {
                let values = [f(&points[0]), f(&points[1]), f(&points[2])];
                (
                    values.iter().copied().fold(f64::INFINITY, f64::min),
                    values.iter().copied().fold(f64::MIN, f64::max),
                )
            };
            let (left, right) = span(|p| p.0);
            let (top, bottom) = span(|p| p.1);
            if right >= 0.0 && left <= (lens.width * SAMPLES) as f64 {
                rows(top, bottom);
            }
        });
    });
    drawn(lens, &bins, |band, t| {
        let corners = corners(t);
        let dims = !lens.culls() && lens.is_back(corners);
        for_each_clipped(lens, corners, |part| {
            let part = if dims { part.map(|v| Vertex { color: dimmed(v.color), ..v }) } else { part };
            band.triangle(lens, &part);
        });
    })
}

/// Draws points as discs that face the camera.
pub(super) fn draw_cloud(lens: &Lens, vertices: &[Vertex], radius_m: f64) -> Rasterised {
    // At least half a pixel, so that a far cloud does not fade; at most a twentieth of the picture.
    let (least, most) = (0.5 * SAMPLES as f64, (lens.height * SAMPLES) as f64 / 20.0);
    let disc = |i: u32| {
        let v = &vertices[i as usize];
        if v.is_hidden() || lens.is_before_near(v) {
            return None;
        }
        let (x, y, nearness) = lens.sample_point(&v.place);
        let radius = radius_m * SAMPLES as f64 / f64::from(lens.pixel_m(nearness));
        Some((x, y, nearness, radius.clamp(least, most.max(least)), v.color))
    };
    let bins = binned(lens, vertices.len(), |i, rows| {
        if let Some((x, y, _, radius, _)) = disc(i)
            && x + radius >= 0.0
            && x - radius <= (lens.width * SAMPLES) as f64
        {
            rows(y - radius, y + radius);
        }
    });
    drawn(lens, &bins, |band, i| {
        if let Some((x, y, nearness, radius, color)) = disc(i) {
            band.disc((x, y), radius, nearness, color);
        }
    })
}

/// Darker and greyer: seen from behind.
fn dimmed(color: [f32; 3]) -> [f32; 3] {
    let grey = (color[0] + color[1] + color[2]) / 3.0;
    color.map(|c| 0.5 * (0.4 * c + 0.6 * grey))
}

/// The part of a triangle in front of the camera, as up to two triangles.
fn for_each_clipped(lens: &Lens, corners: [&Vertex; 3], mut use_part: impl FnMut([Vertex; 3])) {
    if corners.iter().all(|v| !lens.is_before_near(v)) {
        return use_part(corners.map(|v| *v));
    }
    let mut kept: Vec<Vertex> = Vec::with_capacity(4);
    for i in 0..3 {
        let (a, b) = (corners[i], corners[(i + 1) % 3]);
        if !lens.is_before_near(a) {
            kept.push(*a);
        }
        if lens.is_before_near(a) != lens.is_before_near(b) {
            let share = (NEAR_M - a.place[2]) / (b.place[2] - a.place[2]);
            let mut crossing = a.between(b, share);
            // Exactly on the plane, whatever the rounding.
            crossing.place[2] = NEAR_M;
            kept.push(crossing);
        }
    }
    for i in 2..kept.len() {
        use_part([kept[0], kept[i - 1], kept[i]]);
    }
}

/// For every band, the primitives that may overlap it, in their order.
///
/// `extent` calls back with the first and last sample row of each visible part of a primitive.
fn binned(lens: &Lens, count: usize, extent: impl Fn(u32, &mut dyn FnMut(f64, f64)) + Sync) -> Vec<Vec<u32>> {
    const CHUNK: usize = 16_384;
    let bands = lens.height.div_ceil(BAND_ROWS);
    let rows_per_band = (BAND_ROWS * SAMPLES) as f64;
    let chunks: Vec<Vec<Vec<u32>>> = (0..count.div_ceil(CHUNK))
        .into_par_iter()
        .map(|chunk| {
            let mut bins = vec![Vec::new(); bands];
            for i in chunk * CHUNK..count.min((chunk + 1) * CHUNK) {
                let mut span: Option<(f64, f64)> = None;
                extent(i as u32, &mut |top, bottom| {
                    let (t, b) = span.unwrap_or((top, bottom));
                    span = Some((t.min(top), b.max(bottom)));
                });
                let Some((top, bottom)) = span.filter(|s| s.1 >= 0.0 && s.0 <= bands as f64 * rows_per_band)
                else {
                    continue;
                };
                // A margin of one row covers the rounding to sub-sample positions.
                let first = ((top - 1.0) / rows_per_band).max(0.0) as usize;
                let last = (((bottom + 1.0) / rows_per_band).max(0.0) as usize).min(bands - 1);
                for bin in &mut bins[first.min(bands - 1)..=last] {
                    bin.push(i as u32);
                }
            }
            bins
        })
        .collect();
    (0..bands).map(|b| chunks.iter().flat_map(|c| &c[b]).copied().collect()).collect()
}

/// Draws every band with its primitives and joins the bands to a picture.
fn drawn(lens: &Lens, bins: &[Vec<u32>], draw: impl Fn(&mut Band, u32) + Sync) -> Rasterised {
    let bands: Vec<(Vec<[u8; 3]>, Vec<f32>)> = bins
        .par_iter()
        .enumerate()
        .map(|(i, bin)| {
            let rows = BAND_ROWS.min(lens.height - i * BAND_ROWS);
            let mut band = Band::new(lens.width, rows, i * BAND_ROWS);
            for &primitive in bin {
                draw(&mut band, primitive);
            }
            band.resolved()
        })
        .collect();
    let mut frame =
        Rasterised { width: lens.width, height: lens.height, colors: Vec::new(), nearness: Vec::new() };
    for (colors, nearness) in bands {
        frame.colors.extend(colors);
        frame.nearness.extend(nearness);
    }
    frame
}
