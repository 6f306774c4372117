//! Registration of a depth sensor's image to another camera's view.

use vidar_core::{Image, LieGroup, MetricDepth, Pinhole, Se3};

/// Reprojects `depth` into `view`: z-depth in the view's camera, metres, at the view's size.
///
/// Each depth pixel is moved by `view_from_depth` and written to the nearest pixel of the view; where several fall on
/// one pixel, the smallest depth is kept. Pixels of the view that no depth pixel reaches are NaN.
pub fn register_depth(
    depth: &MetricDepth,
    intrinsics: &Pinhole,
    view_from_depth: &Se3,
    view: &Pinhole,
) -> MetricDepth {
    let mut registered = Image::filled(view.width, view.height, f32::NAN);
    let image = depth.image();
    for y in 0..image.height().min(intrinsics.height) {
        for x in 0..image.width().min(intrinsics.width) {
            let z = f64::from(image[(x, y)]);
            if z.is_nan() {
                continue;
            }
            let in_view = view_from_depth.act(&(intrinsics.ray(x as f64, y as f64) * z));
            let Some(pixel) = view.project(&in_view) else { continue };
            let (u, v) = (pixel.x.round(), pixel.y.round());
            if u >= 0.0 && v >= 0.0 && u < view.width as f64 && v < view.height as f64 {
                let target = &mut registered[(u as usize, v as usize)];
                if target.is_nan() || f64::from(*target) > in_view.z {
                    *target = in_view.z as f32;
                }
            }
        }
    }
    MetricDepth::new(registered)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    #[test]
    fn depth_is_that_in_the_view_camera_and_holes_stay_nan() {
        let intrinsics = Pinhole::new(100.0, 100.0, 15.5, 11.5, 32, 24).unwrap();
        let view_from_depth = Se3::from_translation(Vector3::new(0.02, 0.0, 0.5));
        // Left half at 1 m, right half at 2 m; the view's camera is half a metre further back.
        let depth = MetricDepth::new(Image::from_fn(32, 24, |x, _| if x < 16 { 1.0 } else { 2.0 }));
        let view = intrinsics.resized(16, 12).unwrap();
        let registered = register_depth(&depth, &intrinsics, &view_from_depth, &view);
        let values: Vec<f32> = registered.image().data().iter().copied().filter(|z| !z.is_nan()).collect();
        assert!(values.iter().all(|&z| (z - 1.5).abs() < 1e-6 || (z - 2.5).abs() < 1e-6));
        assert!((registered.image()[(4, 6)] - 1.5).abs() < 1e-6);
        assert!((registered.image()[(12, 6)] - 2.5).abs() < 1e-6);
        // From half a metre further back the depth image covers less than the view.
        assert!(registered.image()[(0, 0)].is_nan());
    }

    #[test]
    fn the_nearest_surface_hides_the_one_behind_it() {
        let intrinsics = Pinhole::new(10.0, 10.0, 1.0, 0.0, 3, 1).unwrap();
        let view = Pinhole::new(1.0, 1.0, 0.0, 0.0, 1, 1).unwrap();
        for order in [[3.0, 1.0, 2.0], [1.0, 2.0, 3.0], [2.0, 3.0, 1.0]] {
            let depth = MetricDepth::new(Image::from_vec(3, 1, order.to_vec()).unwrap());
            let registered = register_depth(&depth, &intrinsics, &Se3::IDENTITY, &view);
            assert_eq!(registered.image()[(0, 0)], 1.0, "{order:?}");
        }
    }
}
