use super::*;

fn size(width: usize, height: usize, process_size_px: usize, method: ResizeMethod) -> (usize, usize) {
    processed_size(width, height, &PreprocessConfig { process_size_px, method }).unwrap()
}

#[test]
fn sizes_are_those_of_the_specification() {
    let upper = |w, h| size(w, h, 504, ResizeMethod::UpperBoundResize);
    assert_eq!(upper(752, 480), (504, 322));
    assert_eq!(upper(640, 480), (504, 378));
    assert_eq!(upper(480, 752), (322, 504));
    assert_eq!(upper(1280, 720), (504, 280), "half to even first: 284, then down");
    assert_eq!(upper(504, 376), (504, 378));
    assert_eq!(upper(1241, 376), (504, 154));
    assert_eq!(size(640, 480, 252, ResizeMethod::LowerBoundResize), (336, 252));
    assert_eq!(size(1280, 720, 504, ResizeMethod::UpperBoundCrop), (504, 280));
    assert_eq!(size(1280, 720, 252, ResizeMethod::LowerBoundCrop), (448, 252));
    assert_eq!(size(5000, 3, 504, ResizeMethod::UpperBoundResize), (504, 14), "at least one patch");
}

#[test]
fn a_cut_that_leaves_nothing_is_refused() {
    let config = PreprocessConfig { process_size_px: 504, method: ResizeMethod::UpperBoundCrop };
    let error = plan(5000, 30, &config).unwrap_err().to_string();
    assert!(error.contains("shorter than a patch"), "{error}");
    assert!(plan(0, 30, &config).is_err());
    assert!(PreprocessConfig { process_size_px: 13, ..config }.validate().is_err());
}

#[test]
fn the_same_size_is_left_alone() {
    let config = PreprocessConfig { process_size_px: 28, ..PreprocessConfig::default() };
    assert_eq!(plan(28, 14, &config).unwrap(), []);
    let picture = Image::from_fn(28, 14, |x, y| [x as u8, y as u8, 9]);
    assert_eq!(process(&[&picture], None, &config).unwrap().images[0], picture);
}

#[test]
fn a_constant_picture_stays_constant_however_it_is_resized() {
    let picture = Image::filled(37, 23, [7, 200, 255]);
    for (w, h) in [(20, 11), (37, 5), (9, 23)] {
        assert!(area::resize(&picture, w, h).data().iter().all(|p| *p == [7, 200, 255]), "{w}x{h}");
    }
    assert!(cubic::resize(&picture, 91, 60).data().iter().all(|p| *p == [7, 200, 255]));
}

#[test]
fn shrinking_weighs_by_the_area_covered() {
    // Three columns to two: the middle one is shared by halves.
    let picture = Image::from_fn(3, 1, |x, _| [[0, 90, 240][x]; 3]);
    let half = area::resize(&picture, 2, 1);
    assert_eq!(half.data(), [[30; 3], [190; 3]]);
    let quarter = area::resize(&Image::from_fn(2, 2, |x, y| [[[1, 2], [2, 1]][y][x]; 3]), 1, 1);
    assert_eq!(quarter.data(), [[2; 3]], "6/4 rounds up in a block of two by two");
}

#[test]
fn intrinsics_follow_with_their_origin_at_the_edge() {
    let k = Matrix3::new(500.0, 0.0, 320.0, 0.0, 500.0, 240.0, 0.0, 0.0, 1.0);
    let resize = Step::Resize { width: 320, height: 120, interpolation: Interpolation::Area };
    assert_eq!(
        follow(&k, (640, 480), resize),
        Matrix3::new(250.0, 0.0, 160.0, 0.0, 125.0, 60.0, 0.0, 0.0, 1.0)
    );
    let crop = Step::Crop { left: 3, top: 5, width: 600, height: 400 };
    assert_eq!(follow(&k, (640, 480), crop)[(0, 2)], 317.0);
}

#[test]
fn resizing_is_the_same_with_any_number_of_threads() {
    let picture = crate::weights::synthetic::image_u8(4, 333, 251);
    let run = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| (area::resize(&picture, 100, 77), cubic::resize(&picture, 400, 300)))
    };
    assert_eq!(run(1), run(4));
}
