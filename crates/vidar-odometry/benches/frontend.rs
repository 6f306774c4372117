//! Each stage of the front end on rendered 752 × 480 images: about 150 landmarks.

use divan::{Bencher, black_box};
use nalgebra::{Matrix6, Vector6};
use std::sync::OnceLock;
use vidar_core::{CameraModel, FrameImage, LieGroup, Se3};
use vidar_odometry::frontend::{
    AlignmentPoint, AlignmentReference, Detector, DetectorConfig, Feature, ImageAligner, MotionPrediction,
    Pyramid, RayPair, Template, TwoViewSolver, Warp, align_feature,
};
use vidar_synth::{
    FlightKind, FlightPath, SynthConfig, SynthView, World, euroc_body_from_camera, euroc_camera, render_views,
};

fn main() {
    divan::main();
}

/// A keyframe, the last and the current frame, with features of known distance in the first two.
struct Scene {
    camera: CameraModel,
    images: Vec<FrameImage>,
    pyramids: Vec<Pyramid>,
    world_from_camera: Vec<Se3>,
    /// Features of the keyframe and of the last frame, with inverse distances.
    features: [Vec<(Feature, f64)>; 2],
}

const LANDMARKS: usize = 150;

fn scene() -> &'static Scene {
    static SCENE: OnceLock<Scene> = OnceLock::new();
    SCENE.get_or_init(|| {
        let config = SynthConfig {
            flight: FlightKind::Orbit,
            start: vidar_synth::Start::InFlight,
            ..SynthConfig::euroc()
        };
        let (Ok(path), Ok(camera)) = (FlightPath::built_in(&config), euroc_camera(752, 480)) else {
            unreachable!()
        };
        let Ok(world) = World::build(&config, &path) else { unreachable!() };
        // The keyframe is a quarter of a second old.
        let view = |t: f64| SynthView {
            world_from_camera: path.world_from_body(9.0 + t) * euroc_body_from_camera(),
            camera: camera.clone(),
        };
        let views = [0.0, 0.25, 0.3].map(view);
        let Ok(rendered) = render_views(&world, &views, 3) else { unreachable!() };
        let pyramids: Vec<Pyramid> = rendered.iter().map(|r| Pyramid::of(&r.image.to_gray8(), 5)).collect();
        let features = [0, 1].map(|v| {
            let mut detector = Detector::new(DetectorConfig { cell_px: 24, ..DetectorConfig::default() });
            let grid = detector.grid(752, 480);
            let mut found = Vec::new();
            detector.detect(&pyramids[v], &grid, &mut found);
            let depth = rendered[v].depth.image();
            let known = found.iter().filter_map(|d| {
                let feature = Feature::new(&camera, d.pixel, d.level, d.kind)?;
                let z = f64::from(*depth.get(d.pixel.x.round() as usize, d.pixel.y.round() as usize)?);
                z.is_finite().then(|| (feature, feature.bearing.z / z))
            });
            known.collect::<Vec<_>>()
        });
        Scene {
            images: rendered.into_iter().map(|r| r.image).collect(),
            pyramids,
            world_from_camera: views.iter().map(|v| v.world_from_camera).collect(),
            features,
            camera,
        }
    })
}

impl Scene {
    fn motion(&self, from: usize, to: usize) -> Se3 {
        self.world_from_camera[to].inverse() * self.world_from_camera[from]
    }

    fn landmarks(&self) -> &[(Feature, f64)] {
        &self.features[0][..LANDMARKS.min(self.features[0].len())]
    }

    fn points(&self, view: usize, n: usize) -> Vec<AlignmentPoint> {
        let point = |(f, inverse_distance): &(Feature, f64)| AlignmentPoint {
            pixel: f.pixel,
            bearing: f.bearing,
            inverse_distance: *inverse_distance,
        };
        self.features[view].iter().take(n).map(point).collect()
    }
}

#[divan::bench]
fn pyramid(bencher: Bencher<'_, '_>) {
    let mut pyramid = Pyramid::new(752, 480, 5);
    let image = &scene().images[2];
    bencher.bench_local(|| pyramid.rebuild(black_box(image)));
}

#[divan::bench]
fn detection_at_a_keyframe(bencher: Bencher<'_, '_>) {
    let mut detector = Detector::new(DetectorConfig::default());
    let grid = detector.grid(752, 480);
    let mut found = Vec::new();
    bencher.bench_local(|| detector.detect(black_box(&scene().pyramids[2]), &grid, &mut found));
}

/// `points` in each of two references.
#[divan::bench(args = [60, 120])]
fn image_alignment(bencher: Bencher<'_, '_>, points: usize) {
    let s = scene();
    let (key, last) = (s.points(0, points), s.points(1, points));
    let references = [
        AlignmentReference { pyramid: &s.pyramids[1], anchor_from_reference: Se3::IDENTITY, points: &last },
        AlignmentReference { pyramid: &s.pyramids[0], anchor_from_reference: s.motion(0, 1), points: &key },
    ];
    let off = Vector6::new(0.003, -0.002, 0.003, 0.01, -0.01, 0.01);
    let prediction =
        MotionPrediction { current_from_anchor: s.motion(1, 2).plus(&off), information: Matrix6::identity() };
    let mut aligner = ImageAligner::new(ImageAligner::FINEST_LEVEL);
    bencher.bench_local(|| aligner.align(&s.camera, black_box(&references), &s.pyramids[2], &prediction));
}

#[divan::bench]
fn landmarks_150(bencher: Bencher<'_, '_>) {
    let s = scene();
    let motion = s.motion(0, 2);
    let mut template = Template::empty();
    bencher.bench_local(|| {
        let mut found = 0;
        for (feature, inverse_distance) in s.landmarks() {
            let Some(warp) = Warp::new(&s.camera, feature, *inverse_distance, &motion) else { continue };
            if template.fill(&s.pyramids[0], feature, &warp) {
                found += usize::from(align_feature(&template, &s.pyramids[2], &warp.pixel, 1.0).is_ok());
            }
        }
        found
    });
}

/// Pairs of rays of landmarks found in the current frame, a tenth of them wrong.
fn pairs() -> Vec<RayPair> {
    let s = scene();
    let motion = s.motion(0, 2);
    let pair = |(k, (f, inverse)): (usize, &(Feature, f64))| {
        let b = motion.rotation * f.bearing + motion.translation * *inverse;
        let b = if k % 10 == 0 { b + nalgebra::Vector3::new(0.1, 0.05, 0.0) } else { b };
        RayPair { a: f.bearing, b: b.normalize() }
    };
    s.landmarks().iter().enumerate().map(pair).collect()
}

#[divan::bench]
fn two_view_five_point(bencher: Bencher<'_, '_>) {
    let pairs = pairs();
    let mut solver = TwoViewSolver::default();
    bencher.bench_local(|| solver.solve(black_box(&pairs), 0.5 / 458.0));
}
