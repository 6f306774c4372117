//! A room in closed form: what is filled against what is there.

use super::*;
use nalgebra::Vector3;
use vidar_core::{FrameId, Pinhole, Se3, Timestamp};

const WIDTH: usize = 240;
const HEIGHT: usize = 160;

fn camera() -> Pinhole {
    Pinhole::new(120.0, 120.0, 119.5, 79.5, WIDTH, HEIGHT).unwrap()
}

fn ray(x: usize, y: usize) -> Vector3<f64> {
    let k = camera();
    Vector3::new((x as f64 - k.cx) / k.fx, (y as f64 - k.cy) / k.fy, 1.0)
}

/// z-depth of a slanted wall, and of a dome of radius 3 m seen from within, 1 m before its centre.
fn wall(x: usize, y: usize) -> f32 {
    (3.0 / Vector3::new(0.3, -0.2, 1.0).dot(&ray(x, y))) as f32
}

fn dome(x: usize, y: usize) -> f32 {
    let (ray, center) = (ray(x, y), Vector3::new(0.0, 0.0, 1.0));
    let (a, b, c) = (ray.norm_squared(), ray.dot(&center), center.norm_squared() - 9.0);
    ((b + (b * b - a * c).sqrt()) / a) as f32
}

/// The untextured middle of the image; stereo measures around it.
fn is_blank(x: usize, y: usize) -> bool {
    (50..190).contains(&x) && (30..130).contains(&y)
}

/// A view whose stereo is `depth` outside of the blank middle, and 4 pixels into it.
fn view(depth: fn(usize, usize) -> f32) -> AlignedView {
    let is_measured = |x: usize, y: usize| {
        let inside = |at: usize, low: usize, high: usize| (low + 4..high - 4).contains(&at);
        !(inside(x, 50, 190) && inside(y, 30, 130))
    };
    let stereo = |x, y| if is_measured(x, y) { depth(x, y) } else { f32::NAN };
    let texture = |x: usize, y: usize| match is_blank(x, y) {
        true => [128; 3],
        false => [((x * 7919 + y * 104_729 + x * y) % 251) as u8; 3],
    };
    let full = |value: f32| Confidence::new(Image::filled(WIDTH, HEIGHT, value));
    let depth = MetricDepth::new(Image::from_fn(WIDTH, HEIGHT, stereo));
    let (frame, time) = (FrameId(1), Timestamp::default());
    let view = AlignedView::new(frame, time, Se3::IDENTITY, camera(), depth, full(0.9)).unwrap();
    view.with_color(Image::from_fn(WIDTH, HEIGHT, texture)).unwrap()
}

fn nothing() -> Image<f32> {
    Image::filled(WIDTH, HEIGHT, f32::NAN)
}

/// Largest relative error, and number, of the pixels from one source.
fn worst(view: &AlignedView, truth: fn(usize, usize) -> f32, source: DepthSource) -> (f32, usize) {
    let (depth, origins) = (view.depth().image(), view.origin().unwrap());
    let pixels =
        (0..WIDTH * HEIGHT).map(|i| (i % WIDTH, i / WIDTH)).filter(|at| origins[*at].source == source);
    pixels.fold((0.0, 0), |(worst, n), (x, y)| {
        (f32::max(worst, (depth[(x, y)] / truth(x, y) - 1.0).abs()), n + 1)
    })
}

#[test]
fn a_blank_wall_becomes_a_plane_and_a_blank_dome_does_not() {
    let (map, spread) = (nothing(), Spread::default());
    let evidence = Evidence { map: &map, network: None };
    let flat = complete(&view(wall), &evidence, &spread).unwrap();
    let (error, pixels) = worst(&flat, wall, DepthSource::Plane);
    assert!(pixels > 11_000, "{pixels} of 12 144 empty pixels");
    assert!(error < 2e-3, "{error}");
    let round = complete(&view(dome), &evidence, &spread).unwrap();
    assert_eq!(worst(&round, dome, DepthSource::Plane).1, 0);
    // Its middle is guessed, and said to be worse than a plane.
    let middle = (119, 79);
    let (of_plane, of_guess) = (flat.origin().unwrap()[middle], round.origin().unwrap()[middle]);
    assert_eq!(of_guess.source, DepthSource::Interpolation);
    assert!(of_guess.log_std > 3.0 * of_plane.log_std, "{of_guess:?} {of_plane:?}");
    assert!(round.confidence().image()[middle] < flat.confidence().image()[middle]);
}

#[test]
fn every_pixel_has_the_best_source_there_is() {
    let spread = Spread::default();
    // The surface is known in the left half.
    let map = Image::from_fn(WIDTH, HEIGHT, |x, y| if x < 120 { dome(x, y) * 1.001 } else { f32::NAN });
    let network = Image::from_fn(WIDTH, HEIGHT, |x, y| 0.37 * dome(x, y));
    let own = view(dome);
    let completed = complete(&own, &Evidence { map: &map, network: Some(&network) }, &spread).unwrap();
    let (depth, origins) = (completed.depth().image(), completed.origin().unwrap());
    for y in 0..HEIGHT {
        for x in 0..WIDTH {
            let expected = match (own.depth().image()[(x, y)].is_finite(), x < 120) {
                (true, _) => DepthSource::Stereo,
                (false, true) => DepthSource::Map,
                (false, false) => DepthSource::Network,
            };
            assert_eq!(origins[(x, y)].source, expected, "({x}, {y})");
            assert!(origins[(x, y)].log_std > 0.0 && depth[(x, y)] > 0.0);
        }
    }
    assert_eq!(worst(&completed, dome, DepthSource::Stereo).0, 0.0);
    assert!(worst(&completed, dome, DepthSource::Map).0 < 1.1e-3);
    // A network that has the shape and another unit is bent onto it exactly; without it the dome is cut off.
    let (bent, pixels) = worst(&completed, dome, DepthSource::Network);
    assert!(pixels > 5_000 && bent < 3e-3, "{bent} at {pixels} pixels");
    let cut = complete(&own, &Evidence { map: &map, network: None }, &spread).unwrap();
    assert!(worst(&cut, dome, DepthSource::Interpolation).0 > 0.02);
}

#[test]
fn errors_are_observed_where_the_surface_knows_what_stereo_does_not() {
    let own = view(dome);
    let map = Image::from_fn(WIDTH, HEIGHT, dome);
    // A network whose shape is off by waves of 4 %.
    let waves = |x: usize, y: usize| dome(x, y) * (1.0 + 0.04 * (x as f32 / 9.0).sin());
    let evidence = Evidence { map: &map, network: Some(&Image::from_fn(WIDTH, HEIGHT, waves)) };
    let statistics = errors_where_hidden(&own, &evidence).unwrap();
    let prior = Spread::default();
    let found = statistics.spread(&prior);
    assert!(found != prior);
    let completed = complete(&own, &Evidence { map: &nothing(), ..evidence }, &found).unwrap();
    let (depth, origins) = (completed.depth().image(), completed.origin().unwrap());
    let (mut within, mut guesses, mut sum) = (0, 0, 0.0);
    for (x, y) in (0..WIDTH * HEIGHT).map(|i| (i % WIDTH, i / WIDTH)) {
        if origins[(x, y)].source == DepthSource::Network {
            guesses += 1;
            sum += origins[(x, y)].log_std;
            within += usize::from((depth[(x, y)] / dome(x, y)).ln().abs() < origins[(x, y)].log_std);
        }
    }
    let share = within as f64 / guesses as f64;
    // Waves of 4 % have a median of 2.8 %; σ stands for that, and for holes that nobody sees.
    assert!(share > 0.75, "{share} of {guesses} within their standard deviation");
    let mean = sum / guesses as f32;
    assert!((0.03..0.09).contains(&mean), "{mean}");
}

#[test]
fn a_view_without_depth_stays_without() {
    let view = view(|_, _| f32::NAN);
    let map = nothing();
    let completed =
        complete(&view, &Evidence { map: &map, network: Some(&map) }, &Spread::default()).unwrap();
    assert_eq!(completed.depth().valid_ratio(), 0.0);
    assert!(completed.origin().unwrap().data().iter().all(|o| o.source == DepthSource::None));
    let small = Image::filled(3, 2, 1.0);
    assert!(complete(&view, &Evidence { map: &small, network: None }, &Spread::default()).is_err());
}
