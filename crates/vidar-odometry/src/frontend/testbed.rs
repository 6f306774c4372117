//! Rendered images with exact depth and motion, for the tests of the front end.

use super::detect::{Detection, Detector, DetectorConfig};
use super::feature::Feature;
use super::pyramid::Pyramid;
use nalgebra::Vector3;
use std::sync::OnceLock;
use vidar_core::camera::Pixel;
use vidar_core::random::SplitMix64;
use vidar_core::{CameraModel, Image, LieGroup, Se3};
use vidar_synth::{
    FlightKind, FlightPath, SceneKind, SynthConfig, SynthView, World, euroc_body_from_camera, euroc_camera,
    render_views,
};

/// Levels that the tests use.
pub(crate) const LEVELS: usize = 5;

/// One rendered image.
pub(crate) struct View {
    pub world_from_camera: Se3,
    pub image: Image<u8>,
    pub depth: Image<f32>,
}

/// A keyframe and later images of the same flight.
pub(crate) struct Scene {
    pub camera: CameraModel,
    pub views: Vec<View>,
}

/// Seconds after the keyframe of the views of [`scene`]; the keyframe is view 0.
pub(crate) const OFFSETS_SECS: [f64; 5] = [0.0, 0.05, 0.1, 0.2, 0.5];

/// A room seen by EuRoC's camera at half size, for the suite.
pub(crate) fn scene() -> &'static Scene {
    static SCENE: OnceLock<Scene> = OnceLock::new();
    SCENE.get_or_init(|| render(376, 240, 6.0))
}

/// The same at full size and elsewhere on the flight, for experiments.
pub(crate) fn full_scene() -> &'static Scene {
    static SCENE: OnceLock<Scene> = OnceLock::new();
    SCENE.get_or_init(|| render(752, 480, 9.0))
}

fn render(width: usize, height: usize, secs: f64) -> Scene {
    let config = SynthConfig { scene: SceneKind::Room, flight: FlightKind::Orbit, ..SynthConfig::euroc() };
    let config = SynthConfig { start: vidar_synth::Start::InFlight, ..config };
    let path = FlightPath::built_in(&config).unwrap();
    let world = World::build(&config, &path).unwrap();
    let camera = euroc_camera(width, height).unwrap();
    let views: Vec<SynthView> = OFFSETS_SECS
        .iter()
        .map(|dt| SynthView {
            world_from_camera: path.world_from_body(secs + dt) * euroc_body_from_camera(),
            camera: camera.clone(),
        })
        .collect();
    let rendered = render_views(&world, &views, 5).unwrap();
    let views = views
        .iter()
        .zip(rendered)
        .map(|(view, r)| View {
            world_from_camera: view.world_from_camera,
            image: through_lens(&r.image.to_gray8()),
            depth: r.depth.image().clone(),
        })
        .collect();
    Scene { camera, views }
}

/// The blur of a sharp lens (binomial, σ = 0.6 px): few rays a pixel leave staircases that no camera shows.
fn through_lens(image: &Image<u8>) -> Image<u8> {
    let (w, h) = (image.width(), image.height());
    let at = |x: usize, y: usize| f64::from(image[(x.min(w - 1), y.min(h - 1))]);
    let along =
        |x: usize, y: usize| 0.18 * at(x.saturating_sub(1), y) + 0.64 * at(x, y) + 0.18 * at(x + 1, y);
    Image::from_fn(w, h, |x, y| {
        let sum = 0.18 * along(x, y.saturating_sub(1)) + 0.64 * along(x, y) + 0.18 * along(x, y + 1);
        sum.round() as u8
    })
}

impl Scene {
    pub fn pyramid(&self, view: usize) -> Pyramid {
        Pyramid::of(&self.views[view].image, LEVELS)
    }

    /// `view` as a worse camera saw it: grey levels times `gain` plus noise, clipped.
    pub fn degraded(&self, view: usize, gain: f64, sigma: f64) -> Pyramid {
        let mut random = SplitMix64::new(17 + view as u64);
        let image = self.views[view]
            .image
            .map(|p| (f64::from(*p) * gain + sigma * random.normal()).round().clamp(0.0, 255.0) as u8);
        Pyramid::of(&image, LEVELS)
    }

    /// `view` smeared over `length_px` (odd) along the rows, as by a turn during the exposure.
    pub fn blurred(&self, view: usize, length_px: usize) -> Pyramid {
        let image = &self.views[view].image;
        let reach = (length_px / 2) as isize;
        let blurred = Image::from_fn(image.width(), image.height(), |x, y| {
            let at = |d: isize| (x as isize + d).clamp(0, image.width() as isize - 1) as usize;
            let sum: u32 = (-reach..=reach).map(|d| u32::from(image[(at(d), y)])).sum();
            (f64::from(sum) / (2 * reach + 1) as f64).round() as u8
        });
        Pyramid::of(&blurred, LEVELS)
    }

    pub fn motion(&self, from: usize, to: usize) -> Se3 {
        self.views[to].world_from_camera.inverse() * self.views[from].world_from_camera
    }

    /// Point behind an (integer) pixel of a view, in its camera.
    pub fn point(&self, view: usize, pixel: &Pixel) -> Option<Vector3<f64>> {
        let bearing = self.camera.unproject(pixel)?;
        let (x, y) = (pixel.x.round() as usize, pixel.y.round() as usize);
        // Between pixels the depth is taken from the four around, where they agree.
        let at = |x: usize, y: usize| self.views[view].depth.get(x, y).map(|d| f64::from(*d));
        let (fx, fy) = (pixel.x - pixel.x.floor(), pixel.y - pixel.y.floor());
        let (x0, y0) = (pixel.x as usize, pixel.y as usize);
        let z = if fx == 0.0 && fy == 0.0 {
            at(x, y)?
        } else {
            // Inverse depth is linear over a plane.
            let [a, b, c, d] = [at(x0, y0)?, at(x0 + 1, y0)?, at(x0, y0 + 1)?, at(x0 + 1, y0 + 1)?];
            let spread = a.max(b).max(c).max(d) / a.min(b).min(c).min(d);
            if !(spread < 1.05) {
                return None;
            }
            1.0 / ((1.0 - fy) * ((1.0 - fx) / a + fx / b) + fy * ((1.0 - fx) / c + fx / d))
        };
        (z.is_finite() && z > 0.0).then(|| bearing * (z / bearing.z))
    }

    /// Where a pixel of one view is in another, unless hidden or outside.
    pub fn truth(&self, from: usize, to: usize, pixel: &Pixel) -> Option<Pixel> {
        let point = self.motion(from, to) * self.point(from, pixel)?;
        let seen = self.camera.project(&point)?;
        if !self.camera.contains(&seen, 2.0) {
            return None;
        }
        let depth = f64::from(*self.views[to].depth.get(seen.x.round() as usize, seen.y.round() as usize)?);
        ((depth / point.z - 1.0).abs() < 0.05).then_some(seen)
    }

    /// Whether the surface around a pixel is one: depths within `half_px` differ by less than a tenth.
    pub fn is_smooth(&self, view: usize, pixel: &Pixel, half_px: usize) -> bool {
        let (x, y) = (pixel.x.round() as usize, pixel.y.round() as usize);
        let (mut near, mut far) = (f32::MAX, 0.0_f32);
        for v in y.saturating_sub(half_px)..=y + half_px {
            for u in x.saturating_sub(half_px)..=x + half_px {
                let Some(z) = self.views[view].depth.get(u, v) else { return false };
                (near, far) = (near.min(*z), far.max(*z));
            }
        }
        far < 1.1 * near
    }

    /// Features of a view with their true inverse distances.
    pub fn features(&self, view: usize) -> Vec<(Feature, f64, Detection)> {
        let pyramid = self.pyramid(view);
        let mut detector = Detector::new(DetectorConfig::default());
        let grid = detector.grid(pyramid.width(), pyramid.height());
        let mut found = Vec::new();
        detector.detect(&pyramid, &grid, &mut found);
        let with_depth = |d: &Detection| {
            let point = self.point(view, &d.pixel)?;
            let feature = Feature::new(&self.camera, d.pixel, d.level, d.kind)?;
            Some((feature, 1.0 / point.norm(), *d))
        };
        found.iter().filter_map(with_depth).collect()
    }
}

/// Root mean square.
pub(crate) fn rms(values: &[f64]) -> f64 {
    (values.iter().map(|v| v * v).sum::<f64>() / values.len().max(1) as f64).sqrt()
}

/// Middle value.
pub(crate) fn median(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted.get(sorted.len() / 2).copied().unwrap_or(f64::NAN)
}
