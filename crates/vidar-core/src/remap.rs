//! Undistortion and resizing of images together with their intrinsics.
//!
//! A [`RemapTable`] holds, for each pixel of a distortion-free view, the position of the same direction in the
//! camera's own image. Where a pixel of the view covers several pixels of the image (a reduced view), the table holds a grid
//! of positions spread over the pixel's area and [`RemapTable::apply`] averages them: an area average, so that fine
//! texture becomes grey instead of aliasing.

use crate::camera::{CameraError, CameraModel, LensMotion, Pinhole, Pixel};
use crate::image::{FrameImage, Image};
use crate::lie::{LieGroup, So3};
use nalgebra::{Matrix3x2, Vector2, Vector3};
use rayon::prelude::*;

/// Most sample positions along one side of a pixel; a reduction beyond it is no longer a full average.
const MAX_SAMPLES_PER_SIDE: usize = 16;

/// A pixel may cover this many source pixels more than it has samples; bilinear interpolation spans a full pixel anyway.
const SAMPLE_SLACK: f64 = 0.25;

/// For each pixel of a pinhole view, the positions to sample in the camera's own image.
#[derive(Clone, Debug)]
pub struct RemapTable {
    target: Pinhole,
    samples_per_side: usize,
    /// Source positions, x then y; the samples of one pixel lie together. NaN outside the camera's image.
    source: Vec<[f32; 2]>,
}

/// How a camera moved while a rolling shutter read an image row by row. The camera's pose is that of the middle row.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RowMotion {
    /// Rate of rotation in the camera's frame, rad/s.
    pub turn_rad_per_s: Vector3<f64>,
    /// Velocity in the camera's frame, m/s.
    pub velocity_m_per_s: Vector3<f64>,
    /// Inverse of the scene's typical depth, 1/m; zero where it is not known, which leaves the rotation.
    pub inverse_depth: f64,
    /// Time from the first to the last row, s.
    pub readout_secs: f64,
}

/// How an image differs from what its camera's calibration would show at the instant of its middle row.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ImageWarp {
    /// How the camera moved while the rows were read; `None` for a global shutter, and where it is not known.
    pub rows: Option<RowMotion>,
    /// How the lens had moved when it was taken.
    pub lens: LensMotion,
}

impl ImageWarp {
    /// The pixel at which the calibrated camera would have seen, at one instant, what the image shows at `pixel`; `None` outside the
    /// camera's domain.
    pub fn as_calibrated(&self, camera: &CameraModel, pixel: &Pixel) -> Option<Pixel> {
        let pixel = self.lens.calibrated(camera, pixel, self.row_secs(camera, pixel));
        match &self.rows {
            Some(rows) => rows.at_once(camera, &pixel),
            None => Some(pixel),
        }
    }

    /// The pixel at which the image shows what the calibrated camera sees in the direction `ray` at one instant.
    fn shown(&self, camera: &CameraModel, ray: &Vector3<f64>) -> Option<Pixel> {
        let pixel = match &self.rows {
            Some(rows) => rows.in_row(camera, ray)?,
            None => camera.project(ray)?,
        };
        Some(self.lens.shown(camera, &pixel, self.row_secs(camera, &pixel)))
    }

    /// How long after the middle row a pixel was read, s.
    fn row_secs(&self, camera: &CameraModel, pixel: &Pixel) -> f64 {
        self.rows.as_ref().map_or(0.0, |rows| rows.row_secs(camera, pixel))
    }
}

impl RowMotion {
    /// The pixel at which an instant would have seen what an image shows at `pixel`; `None` outside the camera's domain.
    pub fn at_once(&self, camera: &CameraModel, pixel: &Pixel) -> Option<Pixel> {
        let secs = self.row_secs(camera, pixel);
        let ray = camera.unproject(pixel).filter(|ray| ray.z > 0.0)?;
        let turned = So3::exp(&(self.turn_rad_per_s * secs)) * (ray / ray.z);
        camera.project(&(turned + self.velocity_m_per_s * (secs * self.inverse_depth)))
    }

    /// The pixel at which its row shows what an instant sees in the direction `ray`.
    fn in_row(&self, camera: &CameraModel, ray: &Vector3<f64>) -> Option<Pixel> {
        let mut pixel = camera.project(ray)?;
        for _ in 0..ROW_ROUNDS {
            let secs = self.row_secs(camera, &pixel);
            let shifted = ray / ray.z - self.velocity_m_per_s * (secs * self.inverse_depth);
            pixel = camera.project(&(So3::exp(&(self.turn_rad_per_s * -secs)) * shifted))?;
        }
        Some(pixel)
    }

    /// How long after the middle row a pixel was read, s.
    fn row_secs(&self, camera: &CameraModel, pixel: &Pixel) -> f64 {
        let last_row = camera.height().max(2) as f64 - 1.0;
        self.readout_secs * (pixel.y / last_row - 0.5)
    }
}

/// Where the pixels of a view lie in an image, beside where they would lie in one that the calibrated camera had taken at once.
///
/// Positions are exact at the nodes of a grid and bilinear between them: the shift is smooth, and 16 pixels apart the error is below
/// a hundredth of a pixel at 3 rad/s and 30 ms.
#[derive(Clone, Debug)]
pub struct ViewShift {
    columns: usize,
    nodes: Vec<[f32; 2]>,
    /// Size of the camera's image.
    size: [f32; 2],
}

/// Pixels of the view from one node to the next.
const NODE_SPACING: usize = 16;
/// Rounds in which row and position are found from each other; each lowers the error by the shift per row, a hundredth.
const ROW_ROUNDS: usize = 3;

impl ViewShift {
    /// The shift of a view of `camera`, which has the pose of the middle row; `None` where it stays below `least_px` everywhere.
    ///
    /// What the camera's translation shifts depends on the depth, which is taken to be the typical one everywhere: at 0.5 m/s and 30 ms
    /// the first row is 7 mm from the middle one, and what is twice as far away as that is shifted by 0.2° too much at 1 m.
    pub fn new(camera: &CameraModel, view: &Pinhole, image: &ImageWarp, least_px: f64) -> Option<Self> {
        let (columns, rows) = (view.width.div_ceil(NODE_SPACING) + 1, view.height.div_ceil(NODE_SPACING) + 1);
        let node = |i: usize| {
            let (x, y) = (i % columns * NODE_SPACING, i / columns * NODE_SPACING);
            let ray = view.ray(x as f64, y as f64);
            let shift = |at_once: Pixel| Some(image.shown(camera, &ray)? - at_once);
            camera.project(&ray).and_then(shift).unwrap_or_default()
        };
        let nodes: Vec<Vector2<f64>> = (0..columns * rows).map(node).collect();
        let largest = nodes.iter().map(|n| n.norm()).fold(0.0, f64::max);
        (largest >= least_px).then(|| Self {
            columns,
            nodes: nodes.into_iter().map(|n| [n.x as f32, n.y as f32]).collect(),
            size: [camera.width() as f32, camera.height() as f32],
        })
    }

    /// The shift of a pixel of the view, pixels of the camera.
    fn at(&self, x: usize, y: usize) -> [f32; 2] {
        let first = y / NODE_SPACING * self.columns + x / NODE_SPACING;
        let share = |v: usize| (v % NODE_SPACING) as f32 / NODE_SPACING as f32;
        let (ax, ay) = (share(x), share(y));
        let node = |i: usize| self.nodes[i];
        let [a, b, c, d] =
            [node(first), node(first + 1), node(first + self.columns), node(first + self.columns + 1)];
        std::array::from_fn(|k| {
            let (top, bottom) = (a[k] + ax * (b[k] - a[k]), c[k] + ax * (d[k] - c[k]));
            top + ay * (bottom - top)
        })
    }

    /// Whether a position lies on the image.
    fn holds(&self, at: &[f32; 2]) -> bool {
        (0..2).all(|k| at[k] >= -0.5 && at[k] <= self.size[k] - 0.5)
    }
}

impl RemapTable {
    /// The map from `camera` to the distortion-free view `target`.
    ///
    /// A pixel of the view is covered when all of its samples lie on the image, whose area reaches half a pixel beyond
    /// the centres of its border pixels.
    pub fn new(camera: &CameraModel, target: &Pinhole) -> Self {
        let samples_per_side = samples_per_side(camera, target);
        let per_pixel = samples_per_side * samples_per_side;
        let offset = |i: usize| (i as f64 + 0.5) / samples_per_side as f64 - 0.5;
        let mut source = vec![[f32::NAN; 2]; target.width * target.height * per_pixel];
        source.par_chunks_mut((target.width * per_pixel).max(1)).enumerate().for_each(|(y, row)| {
            for (x, samples) in row.chunks_mut(per_pixel).enumerate() {
                for (i, sample) in samples.iter_mut().enumerate() {
                    let dx = offset(i % samples_per_side);
                    let dy = offset(i / samples_per_side);
                    let pixel = camera.project(&target.ray(x as f64 + dx, y as f64 + dy));
                    if let Some(p) = pixel.filter(|p| camera.contains(p, 0.0)) {
                        *sample = [p.x as f32, p.y as f32];
                    }
                }
                if samples.iter().any(|s| s[0].is_nan()) {
                    samples.fill([f32::NAN; 2]);
                }
            }
        });
        Self { target: *target, samples_per_side, source }
    }

    /// The intrinsics of the resulting view.
    pub fn target(&self) -> &Pinhole {
        &self.target
    }

    /// Share of the target's pixels that the camera covers, 0…1.
    pub fn coverage(&self) -> f64 {
        let per_pixel = self.samples_per_side * self.samples_per_side;
        let covered = self.source.iter().step_by(per_pixel).filter(|s| !s[0].is_nan()).count();
        (covered * per_pixel) as f64 / self.source.len().max(1) as f64
    }

    /// The image resampled to the target view: bilinear, averaged over the pixel's area where the view is reduced;
    /// black outside the camera's image.
    ///
    /// Rows are done in parallel; the result is the same for any number of threads. The image must have the size of
    /// the camera; of a smaller one the border pixels are repeated.
    pub fn apply(&self, image: &FrameImage) -> FrameImage {
        self.apply_shifted(image, None)
    }

    /// As [`RemapTable::apply`], with the positions shifted as this image's are.
    pub fn apply_shifted(&self, image: &FrameImage, shift: Option<&ViewShift>) -> FrameImage {
        match image {
            FrameImage::Gray8(i) => {
                FrameImage::Gray8(self.averaged(i, shift, |p| [f32::from(*p)], |[v]| (v + 0.5) as u8))
            }
            FrameImage::Gray16(i) => {
                FrameImage::Gray16(self.averaged(i, shift, |p| [f32::from(*p)], |[v]| (v + 0.5) as u16))
            }
            FrameImage::Rgb8(i) => FrameImage::Rgb8(self.averaged(
                i,
                shift,
                |p| p.map(f32::from),
                |v: [f32; 3]| v.map(|c| (c + 0.5) as u8),
            )),
        }
    }

    /// The value of the source pixel nearest to each target pixel, `outside` where the camera has no pixel.
    ///
    /// For values that must not be mixed: depths with holes, labels, masks.
    pub fn apply_nearest<P: Copy + Send + Sync>(&self, image: &Image<P>, outside: P) -> Image<P> {
        let (w, h) = (image.width(), image.height());
        let last = |n: usize| n.saturating_sub(1) as f32;
        self.by_rows(outside, |_, samples| {
            if samples[0][0].is_nan() || w == 0 || h == 0 {
                return outside;
            }
            let n = samples.len() as f32;
            let x = samples.iter().map(|s| s[0]).sum::<f32>() / n;
            let y = samples.iter().map(|s| s[1]).sum::<f32>() / n;
            image[(x.round().clamp(0.0, last(w)) as usize, y.round().clamp(0.0, last(h)) as usize)]
        })
    }

    fn samples(&self, x: usize, y: usize) -> &[[f32; 2]] {
        let per_pixel = self.samples_per_side * self.samples_per_side;
        let first = (y * self.target.width + x) * per_pixel;
        &self.source[first..first + per_pixel]
    }

    fn by_rows<P: Copy + Send + Sync>(
        &self,
        fill: P,
        value: impl Fn((usize, usize), &[[f32; 2]]) -> P + Sync,
    ) -> Image<P> {
        let mut out = Image::filled(self.target.width, self.target.height, fill);
        out.data_mut().par_chunks_mut(self.target.width.max(1)).enumerate().for_each(|(y, row)| {
            for (x, pixel) in row.iter_mut().enumerate() {
                *pixel = value((x, y), self.samples(x, y));
            }
        });
        out
    }

    fn averaged<P: Copy + Send + Sync, const C: usize>(
        &self,
        image: &Image<P>,
        shift: Option<&ViewShift>,
        load: impl Fn(&P) -> [f32; C] + Sync,
        store: impl Fn([f32; C]) -> P + Sync,
    ) -> Image<P> {
        let black = store([0.0; C]);
        if image.width() == 0 || image.height() == 0 {
            return Image::filled(self.target.width, self.target.height, black);
        }
        let share = 1.0 / (self.samples_per_side * self.samples_per_side) as f32;
        self.by_rows(black, |(x, y), samples| {
            if samples[0][0].is_nan() {
                return black;
            }
            let mut sum = [0.0; C];
            let mut add = |at: &[f32; 2]| {
                let value = bilinear(image, &load, at);
                for c in 0..C {
                    sum[c] += value[c];
                }
            };
            match shift {
                None => samples.iter().for_each(add),
                Some(shift) => {
                    let [dx, dy] = shift.at(x, y);
                    let moved = |at: &[f32; 2]| [at[0] + dx, at[1] + dy];
                    if !samples.iter().all(|at| shift.holds(&moved(at))) {
                        return black;
                    }
                    samples.iter().for_each(|at| add(&moved(at)));
                }
            }
            store(sum.map(|v| v * share))
        })
    }
}

/// Bilinear interpolation at `at`; beyond the border's pixel centres the border value is repeated.
fn bilinear<P, const C: usize>(
    image: &Image<P>,
    load: impl Fn(&P) -> [f32; C],
    &[x, y]: &[f32; 2],
) -> [f32; C] {
    let (w, h) = (image.width(), image.height());
    let (x, y) = (x.clamp(0.0, (w - 1) as f32), y.clamp(0.0, (h - 1) as f32));
    let (x0, y0) = (x as usize, y as usize);
    let (ax, ay) = (x - x0 as f32, y - y0 as f32);
    let x1 = (x0 + 1).min(w - 1);
    let (upper, lower) = (image.row(y0), image.row((y0 + 1).min(h - 1)));
    let [p00, p10, p01, p11] = [&upper[x0], &upper[x1], &lower[x0], &lower[x1]].map(load);
    let mut value = [0.0; C];
    for c in 0..C {
        let top = p00[c] + ax * (p10[c] - p00[c]);
        let bottom = p01[c] + ax * (p11[c] - p01[c]);
        value[c] = top + ay * (bottom - top);
    }
    value
}

/// How many samples a side a pixel of `target` needs: as many as it spans pixels of `camera`, at the widest place.
fn samples_per_side(camera: &CameraModel, target: &Pinhole) -> usize {
    let d_ray_d_pixel = Matrix3x2::new(1.0 / target.fx, 0.0, 0.0, 1.0 / target.fy, 0.0, 0.0);
    let mut widest: f64 = 1.0;
    for j in 0..=16 {
        for i in 0..=16 {
            let x = (target.width as f64 - 1.0) * f64::from(i) / 16.0;
            let y = (target.height as f64 - 1.0) * f64::from(j) / 16.0;
            let Some((pixel, jacobian)) = camera.project_with_jacobian(&target.ray(x, y)) else { continue };
            if camera.contains(&pixel, 0.0) {
                let span = jacobian * d_ray_d_pixel;
                widest = widest.max(span.column(0).norm()).max(span.column(1).norm());
            }
        }
    }
    ((widest - SAMPLE_SLACK).ceil() as usize).clamp(1, MAX_SAMPLES_PER_SIDE)
}

/// A distortion-free view of `width` × `height` inside the field of view of `camera`, keeping its pixel aspect ratio.
///
/// The focal length is the smallest one, between 0.2 and 5 times the camera's own, for which the whole border of the
/// view is covered; the principal point stays in place. A pinhole camera is only resized.
pub fn undistorted_view(camera: &CameraModel, width: usize, height: usize) -> Result<Pinhole, CameraError> {
    let k = camera.intrinsics().resized(width, height)?;
    if matches!(camera, CameraModel::Pinhole(_)) {
        return Ok(k);
    }
    let view = |zoom: f64| Pinhole::new(k.fx * zoom, k.fy * zoom, k.cx, k.cy, width, height);
    // Zooming in shrinks the field of view; 0.2 to 5 spans every lens that a pinhole view can serve.
    let (mut low, mut high) = (0.2, 5.0);
    if !border_is_covered(camera, &view(high)?) {
        return Err(CameraError::NoUndistortedView { width, height, max_focal_px: k.fx.max(k.fy) * high });
    }
    for _ in 0..40 {
        let mid = 0.5 * (low + high);
        if border_is_covered(camera, &view(mid)?) { high = mid } else { low = mid }
    }
    view(high)
}

/// Whether the outline of the view's area, half a pixel outside its border centres, falls on the camera's image.
fn border_is_covered(camera: &CameraModel, view: &Pinhole) -> bool {
    let covered = |x: f64, y: f64| {
        camera.project(&view.ray(x, y)).is_some_and(|p: Vector2<f64>| camera.contains(&p, 0.0))
    };
    let (right, bottom) = (view.width as f64 - 0.5, view.height as f64 - 0.5);
    (0..=view.width).all(|i| covered(i as f64 - 0.5, -0.5) && covered(i as f64 - 0.5, bottom))
        && (0..=view.height).all(|i| covered(-0.5, i as f64 - 0.5) && covered(right, i as f64 - 0.5))
}
