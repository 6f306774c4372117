//! Undistortion and resizing, compared with scenes rendered directly through the ideal camera.

use nalgebra::{Vector2, Vector3};
use vidar_core::camera::{DoubleSphere, Equidistant, Fov, ParametricCamera, RadTan};
use vidar_core::remap::{ImageWarp, RemapTable, RowMotion, ViewShift, undistorted_view};
use vidar_core::{CameraError, CameraModel, FrameImage, Image, LensMotion, LieGroup, Pinhole, So3};

/// Grey level of the world in a unit direction: waves of `wavelength` (rad, in the middle of the view) on the sky.
fn grey(direction: &Vector3<f64>, wavelength: f64) -> f64 {
    let k = std::f64::consts::TAU / wavelength;
    let (x, y) = (direction.x, direction.y);
    128.0 + 50.0 * (k * x).sin() + 50.0 * (k * (0.8 * y + 0.3 * x)).cos()
}

/// The image of `camera`, each pixel the mean of `n` × `n` rays over its area; 0 where a pixel has no ray in front.
fn draw(camera: &CameraModel, wavelength: f64, n: usize) -> Image<f64> {
    Image::from_fn(camera.width(), camera.height(), |x, y| {
        let mut sum = 0.0;
        for i in 0..n * n {
            let at = |i: usize, base: usize| base as f64 + (i as f64 + 0.5) / n as f64 - 0.5;
            let ray = camera.unproject(&Vector2::new(at(i % n, x), at(i / n, y)));
            sum += ray.filter(|r| r.z > 0.05).map_or(0.0, |r| grey(&r, wavelength));
        }
        sum / (n * n) as f64
    })
}

fn photograph(camera: &CameraModel, wavelength: f64, n: usize) -> FrameImage {
    FrameImage::Gray8(draw(camera, wavelength, n).map(|v| v.round() as u8))
}

/// Largest and root-mean-square difference over the pixels that the camera covers.
fn difference(table: &RemapTable, found: &FrameImage, expected: &Image<f64>) -> (f64, f64) {
    let is_covered = covered(table, expected.width(), expected.height());
    let found = found.to_gray_f32();
    let (mut largest, mut sum, mut n) = (0.0_f64, 0.0, 0.0);
    for y in 0..expected.height() {
        for x in 0..expected.width() {
            if is_covered[(x, y)] {
                let error = (f64::from(found[(x, y)]) - expected[(x, y)]).abs();
                largest = largest.max(error);
                sum += error * error;
                n += 1.0;
            }
        }
    }
    (largest, f64::sqrt(sum / n))
}

/// The table that resizes a distortion-free image.
fn resizing(source: &Pinhole, width: usize, height: usize) -> RemapTable {
    RemapTable::new(&CameraModel::Pinhole(*source), &source.resized(width, height).unwrap())
}

/// Which pixels of the view the camera covers; its image is `width` × `height`.
fn covered(table: &RemapTable, width: usize, height: usize) -> Image<bool> {
    table.apply_nearest(&Image::filled(width, height, true), false)
}

fn distorted_cameras() -> Vec<CameraModel> {
    vec![
        CameraModel::RadTan(RadTan::examples()[0]),
        CameraModel::Equidistant(Equidistant::examples()[0]),
        CameraModel::DoubleSphere(DoubleSphere::examples()[0]),
        CameraModel::Fov(Fov::examples()[1]),
    ]
}

#[test]
fn undistorted_images_agree_with_direct_drawing_within_two_grey_levels() {
    for camera in distorted_cameras() {
        // The best view at full size, whose pixels are at most as fine as the camera's in the middle.
        let view = undistorted_view(&camera, camera.width(), camera.height()).unwrap();
        let table = RemapTable::new(&camera, &view);
        assert_eq!(table.coverage(), 1.0, "{}", camera.name());
        let wavelength = 90.0 / camera.intrinsics().fx;
        let found = table.apply(&photograph(&camera, wavelength, 1));
        let expected = draw(&CameraModel::Pinhole(view), wavelength, 1);
        let (largest, rms) = difference(&table, &found, &expected);
        // Rounding twice gives 0.4 rms and 1 at most; bilinear interpolation adds the rest where the lens compresses.
        assert!(largest < 2.0 && rms < 0.6, "{}: largest {largest:.2}, rms {rms:.2}", camera.name());
    }
}

#[test]
fn reduced_views_average_over_the_area() {
    for camera in distorted_cameras() {
        let (w, h) = (camera.width() / 4, camera.height() / 4);
        let view = undistorted_view(&camera, w, h).unwrap();
        let table = RemapTable::new(&camera, &view);
        assert_eq!(table.coverage(), 1.0, "{}", camera.name());
        // Waves of three target pixels lose a fifth of their height in an area average.
        let wavelength = 3.0 / view.fx;
        let found = table.apply(&photograph(&camera, wavelength, 2));
        let expected = draw(&CameraModel::Pinhole(view), wavelength, 8);
        let (largest, rms) = difference(&table, &found, &expected);
        // One sample a pixel gives 13 and more; the average misses only what bilinear interpolation softens.
        assert!(largest < 4.0 && rms < 1.0, "{}: largest {largest:.2}, rms {rms:.2}", camera.name());
    }
}

#[test]
fn texture_too_fine_for_the_reduced_view_becomes_grey() {
    // A checkerboard of single pixels: point sampling at every fourth pixel would make it black or white.
    let source = Pinhole::examples()[0];
    let board = Image::from_fn(source.width, source.height, |x, y| if (x + y) % 2 == 0 { 255 } else { 0 });
    let image = FrameImage::Gray8(board);
    for (w, h) in [(160, 120), (161, 119), (213, 160), (320, 240), (40, 30)] {
        let table = resizing(&source, w, h);
        let small = table.apply(&image).to_gray8();
        let (least, most) = (small.data().iter().min().unwrap(), small.data().iter().max().unwrap());
        assert!(*least >= 100 && *most <= 155, "{w}x{h}: {least} to {most}");
    }
    let table = resizing(&source, 320, 240);
    assert!(table.apply(&image).to_gray8().data().iter().all(|&v| v == 128));
}

#[test]
fn halving_is_the_mean_of_four_and_no_change_is_no_change() {
    let source = Pinhole::new(50.0, 50.0, 3.5, 2.5, 8, 6).unwrap();
    let image = Image::from_fn(8, 6, |x, y| (x * 17 + y * 31) as u16 * 100);
    let same = resizing(&source, 8, 6);
    assert_eq!(same.apply(&FrameImage::Gray16(image.clone())), FrameImage::Gray16(image.clone()));
    let half = resizing(&source, 4, 3);
    let FrameImage::Gray16(small) = half.apply(&FrameImage::Gray16(image.clone())) else { unreachable!() };
    for y in 0..3 {
        for x in 0..4 {
            let sum: u32 = [(0, 0), (1, 0), (0, 1), (1, 1)]
                .iter()
                .map(|&(i, j)| u32::from(image[(2 * x + i, 2 * y + j)]))
                .sum();
            assert_eq!(u32::from(small[(x, y)]), (sum + 2) / 4);
        }
    }
}

#[test]
fn intrinsics_after_resize_and_crop_show_the_same_point() {
    let full = Pinhole::new(420.0, 430.0, 315.2, 243.9, 640, 480).unwrap();
    let point = Vector3::new(0.21, -0.13, 1.4);
    let at = full.project(&point).unwrap();
    // A bright spot of two pixels' width, drawn where the point projects.
    let spot = |x: usize, y: usize| {
        let d2 = (x as f64 - at.x).powi(2) + (y as f64 - at.y).powi(2);
        (60_000.0 * (-d2 / 32.0).exp()) as u16
    };
    let image = FrameImage::Gray16(Image::from_fn(640, 480, spot));
    let centroid = |image: &FrameImage| {
        let FrameImage::Gray16(image) = image else { unreachable!() };
        let (mut sum, mut mass) = (Vector2::zeros(), 0.0);
        for y in 0..image.height() {
            for x in 0..image.width() {
                let v = f64::from(image[(x, y)]);
                sum += Vector2::new(x as f64, y as f64) * v;
                mass += v;
            }
        }
        sum / mass
    };
    for (w, h) in [(320, 240), (427, 320), (160, 96), (960, 720)] {
        let table = resizing(&full, w, h);
        assert_eq!(table.coverage(), 1.0, "{w}x{h}");
        let expected = table.target().project(&point).unwrap();
        let found = centroid(&table.apply(&image));
        assert!((found - expected).norm() < 0.02, "{w}x{h}: {found:?} instead of {expected:?}");
    }
    let cut = full.cropped(300, 150, 200, 100).unwrap();
    assert!((cut.project(&point).unwrap() - (at - Vector2::new(300.0, 150.0))).norm() < 1e-12);
    let table = RemapTable::new(&CameraModel::Pinhole(full), &cut);
    assert!((centroid(&table.apply(&image)) - cut.project(&point).unwrap()).norm() < 0.02);
    // There and back again gives the same numbers.
    let back = full.resized(320, 240).unwrap().resized(640, 480).unwrap();
    assert!((back.matrix() - full.matrix()).amax() < 1e-12);
}

#[test]
fn pixels_outside_the_camera_image_are_black_and_lower_the_coverage() {
    let camera = CameraModel::Pinhole(Pinhole::new(100.0, 100.0, 49.5, 49.5, 100, 100).unwrap());
    let wide = Pinhole::new(50.0, 50.0, 49.5, 49.5, 100, 100).unwrap();
    let table = RemapTable::new(&camera, &wide);
    assert_eq!(table.coverage(), 0.25);
    let white = FrameImage::Rgb8(Image::filled(100, 100, [255, 254, 253]));
    let FrameImage::Rgb8(found) = table.apply(&white) else { unreachable!() };
    let is_covered = covered(&table, 100, 100);
    assert!(is_covered[(50, 50)] && !is_covered[(10, 50)]);
    assert_eq!((found[(50, 50)], found[(10, 50)]), ([255, 254, 253], [0; 3]));
    // An image of another size, even an empty one, is read without panic.
    assert_eq!(table.apply(&FrameImage::Gray8(Image::filled(0, 0, 7))).width(), 100);
    assert_eq!(table.apply(&FrameImage::Gray8(Image::filled(3, 2, 7))).to_gray8()[(50, 50)], 7);
}

#[test]
fn nearest_sampling_never_mixes_depths() {
    let source = Pinhole::new(50.0, 50.0, 31.5, 23.5, 64, 48).unwrap();
    let depth = Image::from_fn(64, 48, |x, _| if x < 32 { 1.0_f32 } else { 5.0 });
    for (w, h) in [(32, 24), (21, 16), (100, 75)] {
        let small = resizing(&source, w, h).apply_nearest(&depth, f32::NAN);
        assert!(small.data().iter().all(|&z| z == 1.0 || z == 5.0));
        assert_eq!((small[(0, 0)], small[(w - 1, h - 1)]), (1.0, 5.0));
    }
}

#[test]
fn the_result_does_not_depend_on_the_number_of_threads() {
    let camera = CameraModel::RadTan(RadTan::examples()[0]);
    let image = photograph(&camera, 0.05, 1);
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let view = undistorted_view(&camera, 320, 200).unwrap();
            RemapTable::new(&camera, &view).apply(&image)
        })
    };
    assert_eq!(run(1), run(4));
}

#[test]
fn views_of_every_example_are_covered_or_an_error() {
    for camera in CameraModel::examples() {
        match undistorted_view(&camera, 320, 240) {
            Ok(view) => {
                let table = RemapTable::new(&camera, &view);
                assert_eq!(table.coverage(), 1.0, "{camera:?} {view:?}");
            }
            Err(e) => panic!("{camera:?}: {e}"),
        }
    }
    // A camera whose principal point lies far outside its image: no view about its axis exists.
    let aside = Pinhole::new(200.0, 200.0, -4000.0, 240.0, 640, 480).unwrap();
    let aside = CameraModel::Equidistant(Equidistant::new(aside, [0.0; 4]).unwrap());
    let error = undistorted_view(&aside, 640, 480).unwrap_err();
    assert!(matches!(error, CameraError::NoUndistortedView { width: 640, .. }), "{error}");
}

/// The image of a camera that turns while its rows are read; its pose is that of the middle row.
fn photograph_turning(camera: &CameraModel, shutter: &RowMotion, wavelength: f64) -> FrameImage {
    FrameImage::Gray8(Image::from_fn(camera.width(), camera.height(), |x, y| {
        let share = (y as f64 + 0.5) / camera.height() as f64 - 0.5;
        let turned = So3::exp(&(shutter.turn_rad_per_s * (shutter.readout_secs * share)));
        let ray = camera.unproject(&Vector2::new(x as f64, y as f64)).filter(|r| r.z > 0.05);
        ray.map_or(0.0, |r| grey(&(turned * r), wavelength)).round() as u8
    }))
}

#[test]
fn rows_read_while_the_camera_turned_are_put_where_one_instant_sees_them() {
    let shutter = turning(Vector3::new(0.9, -1.4, 0.7), 0.03);
    for camera in distorted_cameras() {
        let view = undistorted_view(&camera, camera.width(), camera.height()).unwrap();
        let table = RemapTable::new(&camera, &view);
        let shift = ViewShift::new(&camera, &view, &by_rows(shutter), 0.25).unwrap();
        let wavelength = 90.0 / camera.intrinsics().fx;
        let rolling = photograph_turning(&camera, &shutter, wavelength);
        let expected = draw(&CameraModel::Pinhole(view), wavelength, 1);
        // Away from the border, beyond which a turned row looks.
        let margin = 24;
        let rms = |found: &FrameImage| {
            let found = found.to_gray_f32();
            let inside = (margin..view.height - margin)
                .flat_map(|y| (margin..view.width - margin).map(move |x| (x, y)));
            let squares: Vec<f64> = inside.map(|p| (f64::from(found[p]) - expected[p]).powi(2)).collect();
            (squares.iter().sum::<f64>() / squares.len() as f64).sqrt()
        };
        let (as_is, corrected) =
            (rms(&table.apply(&rolling)), rms(&table.apply_shifted(&rolling, Some(&shift))));
        assert!(corrected < 1.5, "{}: {corrected} of {as_is} grey levels", camera.name());
        assert!(as_is > 10.0 * corrected, "{}: {corrected} of {as_is} grey levels", camera.name());
    }
}

#[test]
fn what_a_slow_turn_shifts_is_left_where_it_is() {
    let camera = distorted_cameras().remove(0);
    let view = undistorted_view(&camera, camera.width(), camera.height()).unwrap();
    let about_y = |rate: f64| turning(Vector3::new(0.0, rate, 0.0), 0.03);
    assert!(ViewShift::new(&camera, &view, &by_rows(about_y(0.02)), 0.25).is_none());
    assert!(ViewShift::new(&camera, &view, &by_rows(about_y(0.2)), 0.25).is_some());
    let global = turning(Vector3::new(1.0, 1.0, 1.0), 0.0);
    assert!(ViewShift::new(&camera, &view, &by_rows(global), 0.25).is_none());
}

#[test]
fn a_point_at_the_typical_depth_is_where_one_instant_sees_it() {
    let shutter = RowMotion {
        velocity_m_per_s: Vector3::new(0.6, -0.4, 0.3),
        inverse_depth: 1.0 / 1.5,
        ..turning(Vector3::new(0.9, -1.4, 0.7), 0.03)
    };
    let mut judged = 0;
    for camera in distorted_cameras() {
        let (w, h) = (camera.width() as f64, camera.height() as f64);
        for (x, y) in [(0.2, 0.1), (0.5, 0.5), (0.8, 0.9), (0.3, 0.8)] {
            // Fisheyes look sideways in their corners, where there is no depth.
            let ray = camera.unproject(&Vector2::new(x * w, y * h)).filter(|ray| ray.z > 0.3);
            let Some(ray) = ray else { continue };
            judged += 1;
            let point = ray * (1.5 / ray.z);
            // Where its row sees it: the camera has moved on since the middle row.
            let mut row = y * h;
            let seen = |row: f64| {
                let secs = shutter.readout_secs * ((row + 0.5) / h - 0.5);
                let turned = So3::exp(&(shutter.turn_rad_per_s * secs));
                camera.project(&(turned.inverse() * (point - shutter.velocity_m_per_s * secs))).unwrap()
            };
            (0..20).for_each(|_| row = seen(row).y);
            let found = shutter.at_once(&camera, &seen(row)).unwrap();
            // The depth changes by millimetres meanwhile.
            let moved = (seen(row) - Vector2::new(x * w, y * h)).norm();
            let error = (found - Vector2::new(x * w, y * h)).norm();
            assert!(error < 0.05 * moved.max(1.0), "{}: {error} of {moved} px", camera.name());
        }
    }
    assert!(judged >= 10, "{judged}");
}

fn turning(turn_rad_per_s: Vector3<f64>, readout_secs: f64) -> RowMotion {
    RowMotion { turn_rad_per_s, velocity_m_per_s: Vector3::zeros(), inverse_depth: 0.0, readout_secs }
}

fn by_rows(rows: RowMotion) -> ImageWarp {
    ImageWarp { rows: Some(rows), lens: LensMotion::NONE }
}

#[test]
fn an_image_of_a_moved_lens_is_put_where_the_calibrated_camera_sees_it() {
    for (log_focal, shift) in
        [(-0.015, [0.0, 0.0]), (0.02, [0.0, 0.0]), (0.0, [0.02, -0.01]), (0.01, [-0.015, 0.01])]
    {
        for camera in distorted_cameras() {
            let mut parameters = camera.with_longer_focal(log_focal).unwrap().parameters();
            for axis in 0..2 {
                parameters[2 + axis] += shift[axis] * camera.focal_lengths()[axis];
            }
            let moved = camera.with_parameters(&parameters).unwrap();
            let lens = LensMotion { log_focal, shift: shift.into(), ..LensMotion::NONE };
            let image = ImageWarp { rows: None, lens };
            let view = undistorted_view(&camera, camera.width(), camera.height()).unwrap();
            let wavelength = 90.0 / camera.intrinsics().fx;
            let taken = FrameImage::Gray8(draw(&moved, wavelength, 1).map(|v| v.round() as u8));
            let expected = draw(&CameraModel::Pinhole(view), wavelength, 1);
            let shift = ViewShift::new(&camera, &view, &image, 0.25).unwrap();
            let found = RemapTable::new(&camera, &view).apply_shifted(&taken, Some(&shift)).to_gray_f32();
            // Without what the moved lens does not see at the border.
            for y in (view.height / 6..view.height * 5 / 6).step_by(7) {
                for x in (view.width / 6..view.width * 5 / 6).step_by(7) {
                    let off = (f64::from(found[(x, y)]) - expected[(x, y)]).abs();
                    assert!(off < 6.0, "{} ({x}, {y}): {off} grey levels", camera.name());
                }
            }
            let ray = Vector3::new(0.2, -0.1, 1.0);
            let back = image.as_calibrated(&camera, &moved.project(&ray).unwrap()).unwrap();
            assert!((back - camera.project(&ray).unwrap()).norm() < 1e-9, "{}", camera.name());
        }
    }
}
