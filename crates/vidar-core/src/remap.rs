//! Undistortion and resizing with intrinsics that stay right.

use crate::camera::{CameraError, CameraModel, Pinhole};
use crate::image::{FrameImage, Image};
use nalgebra::Vector2;

/// For each pixel of a pinhole view, where to look in the camera's own image.
#[derive(Clone, Debug)]
pub struct RemapTable {
    target: Pinhole,
    /// Source position, x then y; NaN where the camera sees nothing.
    source: Vec<[f32; 2]>,
}

impl RemapTable {
    /// The map from `camera` to the distortion-free view `target`.
    pub fn new(camera: &CameraModel, target: &Pinhole) -> Self {
        let mut source = Vec::with_capacity(target.width * target.height);
        for y in 0..target.height {
            for x in 0..target.width {
                let pixel = camera.project(&target.ray(x as f64, y as f64));
                let inside = pixel.filter(|p| camera.contains(p, 0.5));
                source.push(inside.map_or([f32::NAN; 2], |p| [p.x as f32, p.y as f32]));
            }
        }
        Self { target: *target, source }
    }

    /// The view that the map makes.
    pub fn target(&self) -> &Pinhole {
        &self.target
    }

    /// Share of the target's pixels that the camera sees, 0…1.
    pub fn coverage(&self) -> f64 {
        let seen = self.source.iter().filter(|s| !s[0].is_nan()).count();
        seen as f64 / self.source.len().max(1) as f64
    }

    /// Whether target pixel `(x, y)` is seen by the camera.
    pub fn is_seen(&self, x: usize, y: usize) -> bool {
        !self.source[y * self.target.width + x][0].is_nan()
    }

    /// The image as the target view sees it, bilinear; black where the camera sees nothing.
    pub fn apply(&self, image: &FrameImage) -> FrameImage {
        match image {
            FrameImage::Gray8(i) => {
                FrameImage::Gray8(self.apply_with(i, |p| [f32::from(*p)], |v| v[0].round() as u8))
            }
            FrameImage::Gray16(i) => {
                FrameImage::Gray16(self.apply_with(i, |p| [f32::from(*p)], |v| v[0].round() as u16))
            }
            FrameImage::Rgb8(i) => FrameImage::Rgb8(self.apply_with(
                i,
                |p| p.map(f32::from),
                |v: [f32; 3]| v.map(|c| c.round() as u8),
            )),
        }
    }

    fn apply_with<P: Copy, const C: usize>(
        &self,
        image: &Image<P>,
        load: impl Fn(&P) -> [f32; C],
        store: impl Fn([f32; C]) -> P,
    ) -> Image<P> {
        let (w, h) = (image.width(), image.height());
        Image::from_fn(self.target.width, self.target.height, |x, y| {
            let [sx, sy] = self.source[y * self.target.width + x];
            if sx.is_nan() || w == 0 || h == 0 {
                return store([0.0; C]);
            }
            let (sx, sy) = (sx.clamp(0.0, (w - 1) as f32), sy.clamp(0.0, (h - 1) as f32));
            let (x0, y0) = (sx.floor() as usize, sy.floor() as usize);
            let (x1, y1) = ((x0 + 1).min(w - 1), (y0 + 1).min(h - 1));
            let (ax, ay) = (sx - x0 as f32, sy - y0 as f32);
            let corners = [(x0, y0), (x1, y0), (x0, y1), (x1, y1)].map(|at| load(&image[at]));
            let mut value = [0.0; C];
            for c in 0..C {
                let top = corners[0][c] + ax * (corners[1][c] - corners[0][c]);
                let bottom = corners[2][c] + ax * (corners[3][c] - corners[2][c]);
                value[c] = top + ay * (bottom - top);
            }
            store(value)
        })
    }
}

/// A distortion-free view of `width` × `height` inside what `camera` sees, keeping its aspect of pixels.
///
/// The focal length is the smallest one for which every border pixel of the view is seen by the camera.
pub fn undistorted_view(camera: &CameraModel, width: usize, height: usize) -> Result<Pinhole, CameraError> {
    let k = camera.intrinsics().resized(width, height)?;
    if matches!(camera, CameraModel::Pinhole(_)) {
        return Ok(k);
    }
    let view = |zoom: f64| Pinhole::new(k.fx * zoom, k.fy * zoom, k.cx, k.cy, width, height);
    // Zooming in shrinks the field of view; 0.2 to 5 spans every lens that a pinhole view can serve.
    let (mut low, mut high) = (0.2, 5.0);
    for _ in 0..40 {
        let middle = 0.5 * (low + high);
        if border_is_seen(camera, &view(middle)?) { high = middle } else { low = middle }
    }
    view(high)
}

fn border_is_seen(camera: &CameraModel, view: &Pinhole) -> bool {
    let seen = |x: usize, y: usize| {
        camera.project(&view.ray(x as f64, y as f64)).is_some_and(|p: Vector2<f64>| camera.contains(&p, 0.5))
    };
    let (w, h) = (view.width, view.height);
    (0..w).all(|x| seen(x, 0) && seen(x, h - 1)) && (0..h).all(|y| seen(0, y) && seen(w - 1, y))
}
