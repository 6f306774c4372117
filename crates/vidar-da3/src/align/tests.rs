use super::*;
use nalgebra::Rotation3;

fn camera(position: Vector3<f64>, angle: f64) -> Matrix4<f64> {
    let rotation = Rotation3::from_euler_angles(0.1 * angle, angle, -0.2).into_inner();
    rigid_inverse(&compose(&rotation, &position))
}

/// Given cameras, and what a network would predict of them: half the size, turned.
fn pair(positions: &[Vector3<f64>]) -> (Vec<Matrix4<f64>>, Vec<Matrix4<f64>>) {
    let given: Vec<_> = positions.iter().enumerate().map(|(i, p)| camera(*p, i as f64 * 0.3)).collect();
    let turn = Rotation3::from_euler_angles(0.4, -0.7, 0.2).into_inner();
    let shift = Vector3::new(0.3, 0.1, -2.0);
    let predict = |g: &Matrix4<f64>| {
        let (rotation, position) = parts(&rigid_inverse(g));
        rigid_inverse(&compose(&(turn * rotation), &(turn * position * 0.5 + shift)))
    };
    (given.iter().map(predict).collect(), given)
}

fn bend(n: usize) -> Vec<Vector3<f64>> {
    (0..n).map(|i| i as f64).map(|t| Vector3::new(t, 0.1 * t * t, (t * 0.7).sin())).collect()
}

#[test]
fn a_bent_path_gives_the_similarity_back() {
    let (predicted, given) = pair(&bend(5));
    for is_strict in [false, true] {
        let found = align_cameras(&predicted, &given, is_strict).unwrap();
        assert!((found.scale - 0.5).abs() < 1e-12 && found.scale_source == ScaleSource::Similarity);
        for (p, g) in predicted.iter().zip(&given) {
            assert!((found.to_predicted(g) - p).norm() < 1e-12);
        }
    }
}

#[test]
fn a_line_and_two_views_give_the_length_and_keep_the_cameras_orientation() {
    let line: Vec<_> = (0..4).map(|i| Vector3::new(2.0, -1.0, 0.5) * f64::from(i)).collect();
    for positions in [&line[..], &line[..2]] {
        let (predicted, given) = pair(positions);
        let found = align_cameras(&predicted, &given, false).unwrap();
        assert_eq!(found.scale_source, ScaleSource::LengthAlongLine);
        assert!((found.scale - 0.5).abs() < 1e-9, "{}", found.scale);
        for (p, g) in predicted.iter().zip(&given) {
            assert!((found.to_predicted(g) - p).norm() < 1e-9);
        }
    }
    let (predicted, given) = pair(&line[..2]);
    let refused = align_cameras(&predicted, &given, true).unwrap_err();
    assert!(refused.to_string().contains("2 camera positions on a line"), "{refused}");
}

#[test]
fn coincident_positions_are_reported_as_unobservable_scale() {
    for positions in [vec![Vector3::new(1.0, 2.0, 3.0)], vec![Vector3::new(1.0, 2.0, 3.0); 4]] {
        let (predicted, given) = pair(&positions);
        let found = align_cameras(&predicted, &given, false).unwrap();
        assert_eq!((found.scale_source, found.scale), (ScaleSource::Unobservable, 1.0));
        assert!(found.translation.iter().all(|v| v.is_finite()));
        assert!(align_cameras(&predicted, &given, true).is_err());
    }
}

#[test]
fn from_ten_views_on_an_outlier_is_left_out() {
    let (mut predicted, given) = pair(&bend(16));
    predicted[11] = camera(Vector3::new(40.0, -30.0, 9.0), 1.0);
    let found = align_cameras(&predicted, &given, false).unwrap();
    assert_eq!(found.scale_source, ScaleSource::SimilarityOfInliers);
    assert!(found.inliers < 16 && (found.scale - 0.5).abs() < 1e-6, "{found:?}");
}

#[test]
fn predictions_that_are_not_finite_give_no_scale() {
    let (mut predicted, given) = pair(&bend(4));
    predicted[2][(0, 3)] = f64::NAN;
    let found = align_cameras(&predicted, &given, false).unwrap();
    assert_eq!(found.scale_source, ScaleSource::Unobservable);
}
