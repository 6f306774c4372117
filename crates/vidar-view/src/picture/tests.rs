use super::*;

fn ramp() -> Image<f32> {
    Image::from_fn(400, 200, |x, _| if x < 50 { f32::NAN } else { x as f32 / 100.0 })
}

#[test]
fn depth_keeps_its_pixels_and_gains_a_scale_at_the_right() {
    let picture = depth_picture(&ramp(), Some((0.5, 4.0)));
    assert!(picture.width() > 400 && picture.width() < 560);
    assert_eq!(picture.height(), 200);
    assert_eq!(picture[(10, 100)], theme::NO_DATA);
    assert_eq!(picture[(50, 100)], ColorMap::Sea.color(1.0), "near is bright");
    assert_eq!(picture[(225, 20)], ColorMap::Sea.color((4.0 - 2.25) / 3.5));
    // The scale beside it: far at the top, near at the bottom, both within the bar.
    let line = 16.0_f64;
    let x = (400.0 + 0.7 * line + 0.5 * line) as usize;
    assert_eq!(picture[(x, (0.6 * line) as usize + 3)], ColorMap::Sea.color(0.01));
    let bottom = picture[(x, 200 - (0.6 * line) as usize - 4)];
    assert!(bottom[1] > 200, "{bottom:?}");
}

#[test]
fn without_a_range_outliers_do_not_set_the_colours() {
    let mut depth = Image::from_fn(400, 300, |x, _| 1.0 + x as f32 / 400.0);
    depth[(3, 3)] = 1e6;
    let picture = depth_picture(&depth, None);
    let (near, far) = (picture[(1, 100)], picture[(399, 100)]);
    assert_eq!((near, far), (ColorMap::Sea.color(1.0), ColorMap::Sea.color(0.0)));
}

#[test]
fn low_confidence_is_dark() {
    let picture = confidence_picture(&Image::from_fn(320, 240, |x, _| x as f32 / 319.0));
    assert_eq!(picture[(0, 0)], ColorMap::Sea.color(0.0));
    assert_eq!(picture[(319, 0)], ColorMap::Sea.color(1.0));
}

#[test]
fn degenerate_inputs_give_pictures() {
    let odd = [
        Image::filled(0, 0, 1.0),
        Image::filled(1, 1, 2.0),
        Image::filled(7, 900, f32::NAN),
        Image::filled(64, 48, f32::INFINITY),
        Image::filled(64, 48, -1.0),
        Image::filled(20_000, 2, 3.0),
    ];
    for image in odd {
        for range in [None, Some((2.0, 2.0)), Some((f32::NAN, 1.0))] {
            let picture = depth_picture(&image, range);
            assert!(picture.width() > 80 && picture.width() < 9000 && picture.height() >= PictureSize::MIN);
        }
        confidence_picture(&image);
    }
}

#[test]
fn pictures_side_by_side_have_one_height_and_keep_their_pixels() {
    let red = Picture::filled(300, 200, [255, 0, 0]);
    let blue = Picture::filled(75, 50, [0, 0, 255]);
    let both = side_by_side(&[("first", &red), ("a second one whose name is long", &blue)]);
    let count = |c: [u8; 3]| both.data().iter().filter(|p| **p == c).count();
    assert_eq!(count([255, 0, 0]), 300 * 200);
    assert_eq!(count([0, 0, 255]), 300 * 200, "enlarged to the same height");
    assert!(both.height() >= 200 + 16);
}

#[test]
fn no_pictures_and_empty_pictures_side_by_side_are_accepted() {
    let empty = Picture::filled(0, 0, [0; 3]);
    assert!(!side_by_side(&[]).data().is_empty());
    assert!(!side_by_side(&[("nothing", &empty)]).data().is_empty());
}

#[test]
fn reducing_averages_instead_of_skipping() {
    let stripes = Picture::from_fn(300, 400, |x, _| if x % 2 == 0 { [0; 3] } else { [255; 3] });
    let small = at_height(&stripes, 100);
    assert_eq!((small.width(), small.height()), (75, 100));
    assert!(small.data().iter().all(|p| p[0] > 100 && p[0] < 155));
}
