use super::*;
use crate::map::camera::up_of_world;
use vidar_core::{BodyFrame, CameraId, LieGroup, Se3, So3, StampedPose, Timestamp};

fn path(points: &[[f64; 3]]) -> Trajectory {
    let poses = points.iter().enumerate().map(|(i, p)| StampedPose {
        time: Timestamp::from_nanos(i as i64 * 50_000_000),
        world_from_body: Se3::from_translation(Vector3::from(*p)),
    });
    Trajectory::new(BodyFrame::Imu, poses.collect()).unwrap()
}

fn circle(radius: f64) -> Trajectory {
    let at = |i: i32| (f64::from(i) * std::f64::consts::TAU / 720.0).sin_cos();
    path(&(0..720).map(|i| [40.0 + radius * at(i).1, -7.0 + radius * at(i).0, 1.0]).collect::<Vec<_>>())
}

/// Width and height of what is drawn in a colour, below the legend.
fn extent(picture: &Picture, color: [u8; 3]) -> (usize, usize) {
    let all = (80..picture.height()).flat_map(|y| (0..picture.width()).map(move |x| (x, y)));
    let ink: Vec<_> = all.filter(|&(x, y)| picture[(x, y)] == color).collect();
    let span =
        |k: fn(&(usize, usize)) -> usize| ink.iter().map(k).max().unwrap() - ink.iter().map(k).min().unwrap();
    (span(|p| p.0), span(|p| p.1))
}

#[test]
fn a_circle_stays_a_circle_in_any_format() {
    let truth = circle(3.0);
    for size in [PictureSize::new(1200, 500), PictureSize::new(700, 1100), PictureSize::default()] {
        let plot = TrajectoryPlot { side_view: false, ..TrajectoryPlot::default() };
        let picture = plot_trajectories(&[PlotTrajectory::ground_truth("truth", &truth)], &plot, size);
        let (w, h) = extent(&picture, theme::TRUTH);
        assert!(w > 200 && w.abs_diff(h) <= 12, "{size:?}: {w} x {h}");
    }
}

#[test]
fn both_panels_have_one_scale_and_hold_all_data() {
    let long = path(&[[0.0, 0.0, 0.0], [12.0, 3.0, 0.5], [20.0, -4.0, 2.0]]);
    let plane = HorizontalPlane::of_up(&Vector3::z());
    let paths = coloured_paths(&[PlotTrajectory::estimate("a", &long)], &plane);
    let outer = Area { left: 0.0, top: 80.0, width: 1200.0, height: 820.0 };
    let panels = Panels::layout(&paths, &plane, true, &outer, PictureSize::default().type_scale());
    let (side, _, _) = panels.side.unwrap();
    let scales = [
        panels.top.area.width / (panels.top.x.1 - panels.top.x.0),
        panels.top.area.height / (panels.top.y.1 - panels.top.y.0),
        side.area.width / (side.x.1 - side.x.0),
        side.area.height / (side.y.1 - side.y.0),
    ];
    assert!(scales.iter().all(|s| (s / scales[0] - 1.0).abs() < 1e-9), "{scales:?}");
    for p in &paths[0].points {
        assert!(p[0] > panels.top.x.0 && p[0] < panels.top.x.1);
        assert!(p[1] > panels.top.y.0 && p[1] < panels.top.y.1);
        assert!(p[2] > side.y.0 && p[2] < side.y.1);
    }
    assert!(side.area.bottom() < 900.0);
}

#[test]
fn an_unobserved_interval_is_not_drawn_as_a_path() {
    let mut poses = circle(3.0).poses().to_vec();
    poses.drain(100..300);
    let broken = Trajectory::new(BodyFrame::Imu, poses).unwrap();
    let plane = HorizontalPlane::of_up(&Vector3::z());
    let paths = coloured_paths(&[PlotTrajectory::estimate("a", &broken)], &plane);
    let breaks: Vec<usize> = (0..paths[0].joined.len()).filter(|&i| !paths[0].joined[i]).collect();
    assert_eq!(breaks, [0, 100]);
}

#[test]
fn ground_truth_is_drawn_behind_in_any_order() {
    let (a, b) = (circle(3.0), circle(3.0));
    let items = [PlotTrajectory::estimate("a", &a), PlotTrajectory::ground_truth("b", &b)];
    let one = plot_trajectories_top_down(&items, PictureSize::new(640, 480));
    let two = plot_trajectories_top_down(&[items[1], items[0]], PictureSize::new(640, 480));
    assert!(one == two);
    assert!(extent(&one, theme::DATA[0]).0 > 50, "the estimate is seen on top");
}

#[test]
fn degenerate_paths_give_plots() {
    let far: Vec<[f64; 3]> = (0..50).map(|i| [1e12 + f64::from(i), 1e300, -1e300]).collect();
    let many: Vec<[f64; 3]> = (0..30_000).map(|i| [f64::from(i).sin(), f64::from(i).cos(), 0.0]).collect();
    let paths = [
        path(&[]),
        path(&[[1.0, 2.0, 3.0]]),
        path(&[[7.0; 3]; 9]),
        path(&far),
        path(&many),
        path(&[[0.0; 3], [1e14, 0.0, 0.0]]),
    ];
    for p in &paths {
        for size in [PictureSize::new(1, 1), PictureSize::new(800, 600), PictureSize::new(200, 900)] {
            let long_name = "x".repeat(300);
            let picture = plot_trajectories_top_down(&[PlotTrajectory::estimate(&long_name, p)], size);
            assert_eq!(picture.height(), size.height());
        }
    }
    plot_trajectories_top_down(&[], PictureSize::default());
}

#[test]
fn axes_with_another_up_are_named_and_right_handed() {
    for (up, names) in [
        (Vector3::z(), ["x", "y", "z"]),
        (-Vector3::z(), ["x", "-y", "-z"]),
        (Vector3::y(), ["x", "-z", "y"]),
        (-Vector3::y(), ["x", "z", "-y"]),
        (Vector3::x(), ["y", "z", "x"]),
        (-Vector3::x(), ["z", "y", "-x"]),
    ] {
        let plane = HorizontalPlane::of_up(&up);
        assert_eq!(plane.names, names);
        let columns =
            [Vector3::x(), Vector3::y(), Vector3::z()].map(|v| Vector3::from(plane.coordinates(&v)));
        assert!((nalgebra::Matrix3::from_columns(&columns).determinant() - 1.0).abs() < 1e-12);
        assert_eq!(plane.coordinates(&up), [0.0, 0.0, 1.0]);
    }
    let plane = HorizontalPlane::of_up(&Vector3::new(0.5, 0.5, 0.7));
    assert!(
        (Vector3::from(plane.coordinates(&Vector3::new(0.5, 0.5, 0.7))).normalize().z - 1.0).abs() < 1e-12
    );
    assert_eq!(HorizontalPlane::of_up(&Vector3::zeros()).names, ["x", "y", "z"]);
}

#[test]
fn up_is_estimated_from_the_cameras() {
    let held = |world_from_level: So3| {
        // Level camera of a world with z up: x right, y down, z along world y; then nodding a little.
        let level = So3::exp(&Vector3::new(-std::f64::consts::FRAC_PI_2, 0.0, 0.0));
        let poses = (0..20).map(|i| StampedPose {
            time: Timestamp::from_nanos(i),
            world_from_body: Se3::new(
                world_from_level
                    * level
                    * So3::exp(&Vector3::new(0.02 * i as f64 - 0.1, 0.3 * i as f64, 0.0)),
                Vector3::zeros(),
            ),
        });
        up_of_world(&Trajectory::new(BodyFrame::Camera(CameraId(0)), poses.collect()).unwrap())
    };
    assert_eq!(held(So3::IDENTITY), Vector3::z());
    // The same recording in the frame of its first camera, where up is -y.
    assert_eq!(held(So3::exp(&Vector3::new(std::f64::consts::FRAC_PI_2, 0.0, 0.0))), -Vector3::y());
    assert_eq!(up_of_world(&path(&[])), Vector3::z());
}

#[test]
fn scale_bars_have_common_units() {
    assert_eq!([2000.0, 5.0, 0.5, 0.02, 0.005].map(metres_label), ["2 km", "5 m", "50 cm", "2 cm", "5 mm"]);
}
