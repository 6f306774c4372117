use super::camera::{BackFaces, Viewpoint};
use super::*;
use nalgebra::Vector3;
use vidar_core::{BodyFrame, CameraId, Se3, So3, StampedPose, Timestamp};

const RED: [u8; 3] = [255, 0, 0];
const BLUE: [u8; 3] = [0, 0, 255];

/// Looks down on the x-y plane; 200 × 200 pixels show 2 × 2 m around the origin.
fn from_above() -> MapCamera {
    MapCamera {
        name: "test".to_owned(),
        position: Vector3::new(0.0, 0.0, 10.0),
        right: Vector3::x(),
        down: -Vector3::y(),
        projection: Projection::Orthographic { height_m: 2.0 },
        back_faces: BackFaces::Cull,
    }
}

fn triangles(corners: &[[f32; 3]], colors: &[[u8; 3]]) -> TriangleMesh {
    TriangleMesh {
        positions: corners.to_vec(),
        colors: colors.iter().flat_map(|c| [*c; 3]).collect(),
        triangles: (0..corners.len() as u32 / 3).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect(),
        ..TriangleMesh::default()
    }
}

/// The picture without annotation and crease shading.
fn drawn(mesh: &TriangleMesh, camera: &MapCamera, size: usize) -> Vec<[u8; 3]> {
    let lens = Lens::new(camera, size, size).unwrap();
    let vertices = paint::painted(&MapSurface::Mesh(mesh), &lens, &Shading::Color);
    raster::draw_mesh(&lens, &vertices, &mesh.triangles).colors
}

#[test]
fn a_projected_triangle_covers_exactly_its_area() {
    // Right triangle with legs of 1 m = 100 pixels, corners on pixel borders.
    let mesh = triangles(&[[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, 0.5, 0.0]], &[RED]);
    let picture = drawn(&mesh, &from_above(), 200);
    for y in 0..200_i32 {
        for x in 0..200_i32 {
            // Row 50 is y = +0.5: the leg at the left is 100 high, the one at the bottom 100 wide.
            let inside_by = if (50..150).contains(&x) && (50..150).contains(&y) { y - x } else { -1000 };
            let found = picture[(y * 200 + x) as usize];
            match inside_by {
                d if d > 0 => assert_eq!(found, RED, "{x} {y}"),
                0 => assert!(found[1] > 80 && found[1] < 175, "half of the diagonal pixel: {found:?}"),
                _ => assert_eq!(found, [255; 3], "{x} {y}"),
            }
        }
    }
}

#[test]
fn neighbours_share_no_sample_and_leave_none_out() {
    // A fan of triangles around a point that lies on no grid; each sample must be hit exactly once.
    let center = [0.013, -0.027, 0.0];
    let rim: Vec<[f32; 3]> =
        (0..37).map(|i| (i as f32 * 0.169_8).sin_cos()).map(|(s, c)| [0.8 * c, 0.8 * s, 0.0]).collect();
    let lens = Lens::new(&from_above(), 200, 200).unwrap();
    let mut hits = vec![0; 200 * 200];
    let mut whole = Vec::new();
    for i in 0..36 {
        let corners = [center, rim[i], rim[i + 1]];
        whole.extend(corners);
        let one = drawn(&triangles(&corners, &[[0; 3]]), &from_above(), 200);
        for (h, p) in hits.iter_mut().zip(&one) {
            // 9 samples per pixel: the grey level counts those that were hit.
            *h += ((255.0 - f64::from(p[0])) * 9.0 / 255.0).round() as i32;
        }
    }
    let all = drawn(&triangles(&whole, &[[0; 3]; 36]), &from_above(), 200);
    for (h, p) in hits.iter().zip(&all) {
        let together = ((255.0 - f64::from(p[0])) * 9.0 / 255.0).round() as i32;
        assert_eq!(*h, together);
    }
    assert!(hits.iter().filter(|h| **h == 9).count() > 18_000);
    assert_eq!(lens.picture_point(&Vector3::new(0.0, 0.0, 0.0)), Some((100.0, 100.0)));
}

#[test]
fn what_is_nearer_hides_what_is_farther_in_any_order() {
    let low = [[-0.9, -0.9, 0.0], [0.9, -0.9, 0.0], [0.0, 0.9, 0.0]];
    let high = [[-0.9, -0.9, 1.0], [0.9, -0.9, 1.0], [0.0, 0.9, 1.0]];
    for (first, second, colors) in [(low, high, [RED, BLUE]), (high, low, [BLUE, RED])] {
        let mesh = triangles(&[first, second].concat(), &colors);
        assert!(is_like(drawn(&mesh, &from_above(), 200)[100 * 200 + 100], 2));
        let perspective =
            MapCamera { projection: Projection::Perspective { vertical_angle_deg: 30.0 }, ..from_above() };
        assert!(is_like(drawn(&mesh, &perspective, 200)[100 * 200 + 100], 2));
    }
}

#[test]
fn planes_that_cross_are_cut_where_they_meet() {
    // One rises to the right, the other falls; from above the right half shows the first.
    let mesh = triangles(
        &[
            [-0.9, -0.9, -0.9],
            [0.9, -0.9, 0.9],
            [0.0, 0.9, 0.0],
            [-0.9, -0.9, 0.9],
            [0.9, -0.9, -0.9],
            [0.0, 0.9, 0.0],
        ],
        &[RED, BLUE],
    );
    let picture = drawn(&mesh, &from_above(), 200);
    let is =
        |x: usize, main: usize| picture[150 * 200 + x][main] > 150 && picture[150 * 200 + x][2 - main] < 20;
    assert!(is(70, 2) && is(98, 2) && is(102, 0) && is(130, 0));
}

#[test]
fn back_faces_are_left_out_or_dimmed() {
    let back = [[-0.9, -0.9, 0.0], [0.0, 0.9, 0.0], [0.9, -0.9, 0.0]];
    let mesh = triangles(&back, &[RED]);
    assert!(drawn(&mesh, &from_above(), 200).iter().all(|p| *p == [255; 3]));
    let dim = MapCamera { back_faces: BackFaces::Dim, ..from_above() };
    let [r, g, _] = drawn(&mesh, &dim, 200)[100 * 200 + 100];
    assert!(r < 140 && g > 20 && r > g, "{r} {g}");
}

/// The inside of a 4 × 3 × 2.5 m box, seen faces inwards: floor red, ceiling blue, walls grey.
fn room() -> TriangleMesh {
    let corner = |i: u32| [4.0 * (i & 1) as f32, 3.0 * (i >> 1 & 1) as f32, 2.5 * (i >> 2 & 1) as f32];
    let faces = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]];
    let mut mesh = TriangleMesh::default();
    for (i, face) in faces.iter().enumerate() {
        let start = mesh.positions.len() as u32;
        mesh.positions.extend(face.map(corner));
        mesh.colors.extend([[RED, BLUE, [128; 3]][i.min(2)]; 4]);
        mesh.triangles.extend([[start, start + 1, start + 2], [start, start + 2, start + 3]]);
    }
    mesh
}

fn is_like(p: [u8; 3], main: usize) -> bool {
    p[main] > 120 && (0..3).all(|i| i == main || p[i] < p[main] / 3)
}

#[test]
fn the_inside_of_a_closed_room_is_visible_from_outside() {
    let mesh = room();
    for viewpoint in [Viewpoint::Top, Viewpoint::ThreeQuarterFront, Viewpoint::ThreeQuarterBack] {
        let camera = MapCamera::fixed(viewpoint, &mesh.positions, None, &Vector3::z(), 4.0 / 3.0);
        let picture =
            render_map(MapSurface::Mesh(&mesh), &camera, PictureSize::new(640, 480), Shading::Color).unwrap();
        let floor = picture.data().iter().filter(|p| is_like(**p, 0)).count();
        let ceiling = picture.data().iter().filter(|p| is_like(**p, 2)).count();
        assert!(floor > 30_000 && ceiling == 0, "{viewpoint:?}: {floor} {ceiling}");
        // The room does not touch the picture's border.
        let border = |p: &[u8; 3]| *p == theme::PAPER;
        assert!(
            picture.row(0).iter().all(border) && picture.row(470).iter().take(300).all(border),
            "{viewpoint:?}"
        );
    }
}

fn camera_path() -> Trajectory {
    // Level, looking along +y, from the middle of the room.
    let rotation = So3::from_axis_angle(&Vector3::x(), -std::f64::consts::FRAC_PI_2);
    let poses = (0..5).map(|i| StampedPose {
        time: Timestamp::from_nanos(i * 1_000_000),
        world_from_body: Se3::new(rotation, Vector3::new(1.8 + 0.1 * i as f64, 1.0, 1.3)),
    });
    Trajectory::new(BodyFrame::Camera(CameraId(0)), poses.collect()).unwrap()
}

#[test]
fn the_inside_view_is_upright_and_clips_what_is_behind_the_eye() {
    let mesh = room();
    let camera =
        MapCamera::fixed(Viewpoint::Inside, &mesh.positions, Some(&camera_path()), &Vector3::z(), 4.0 / 3.0);
    assert!((camera.forward() - Vector3::y()).norm() < 1e-9 && (camera.down + Vector3::z()).norm() < 1e-9);
    let picture =
        render_map(MapSurface::Mesh(&mesh), &camera, PictureSize::new(640, 480), Shading::Color).unwrap();
    assert!(is_like(picture[(320, 475)], 0), "floor below: {:?}", picture[(320, 475)]);
    assert!(is_like(picture[(320, 5)], 2), "ceiling above: {:?}", picture[(320, 5)]);
    let [r, g, b] = picture[(320, 240)];
    assert!(r == g && g == b && r > 100, "wall ahead");
    assert!(picture.data().iter().all(|p| *p != theme::PAPER), "walls reach past the eye on all sides");
}

#[test]
fn the_same_pixels_come_from_one_and_from_four_threads() {
    let mesh = room();
    let mut cloud = PointCloud::default();
    for i in 0..40_000_u32 {
        let h = |k: u32| {
            (i.wrapping_mul(2_654_435_761).wrapping_add(k.wrapping_mul(40_503)) >> 8) as f32
                / (1 << 24) as f32
        };
        cloud.positions.push([4.0 * h(1), 3.0 * h(7_919), h(104_729)]);
        cloud.colors.push([(i % 256) as u8, 90, 10]);
    }
    let path = camera_path();
    let pictures = [1, 4].map(|threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let size = PictureSize::new(500, 400);
            [MapSurface::Mesh(&mesh), MapSurface::Cloud(&cloud)].map(|surface| {
                let camera = MapCamera::fixed(
                    Viewpoint::ThreeQuarterFront,
                    surface.positions(),
                    None,
                    &Vector3::z(),
                    1.25,
                );
                render_map_with_path(surface, &camera, size, Shading::Color, Some(&path)).unwrap()
            })
        })
    });
    assert!(pictures[0] == pictures[1]);
}

#[test]
fn a_dense_cloud_covers_its_surface() {
    let mut cloud = PointCloud::default();
    for y in 0..150 {
        for x in 0..200 {
            for (z, color) in [(0.0, RED), (2.5, BLUE)] {
                cloud.positions.push([x as f32 * 0.02, y as f32 * 0.02, z]);
                cloud.colors.push(color);
            }
        }
    }
    let camera = MapCamera::fixed(Viewpoint::Top, &cloud.positions, None, &Vector3::z(), 4.0 / 3.0);
    let size = PictureSize::new(640, 480);
    let picture = render_map(MapSurface::Cloud(&cloud), &camera, size, Shading::Color).unwrap();
    // Away from the border and the scale bar.
    let inner = (60..400).flat_map(|y| (60..580).map(move |x| (x, y)));
    let covered = inner.filter(|&(x, y)| is_like(picture[(x, y)], 2)).count();
    assert_eq!(covered, 340 * 520, "the ceiling hides the floor, without holes");
}

#[test]
fn errors_are_coloured_by_their_scale() {
    let mesh = triangles(&[[-0.9, -0.9, 0.0], [0.9, -0.9, 0.0], [0.0, 0.9, 0.0]], &[RED]);
    let at = |value: f32| {
        let shading = Shading::Error { values: &[value; 3], range: (0.0, 0.1), label: "distance [m]" };
        render_map(MapSurface::Mesh(&mesh), &from_above(), PictureSize::new(400, 400), shading).unwrap()
            [(200, 150)]
    };
    assert_eq!(at(0.0), ColorMap::Ember.color(0.0));
    assert_eq!(at(0.05), ColorMap::Ember.color(0.5));
    assert_eq!(at(9.0), ColorMap::Ember.color(1.0));
    let [r, g, b] = at(f32::NAN);
    assert!(r.abs_diff(g) <= 3 && g.abs_diff(b) <= 3);
}

#[test]
fn inconsistent_surfaces_and_values_are_refused() {
    let mut mesh = room();
    let camera = from_above();
    let size = PictureSize::new(200, 200);
    let shading = Shading::Error { values: &[1.0], range: (0.0, 1.0), label: "" };
    let error = render_map(MapSurface::Mesh(&mesh), &camera, size, shading).unwrap_err();
    assert!(error.to_string().contains("expected 24 (one per vertex), found 1"), "{error}");
    mesh.triangles.push([0, 1, 99]);
    let error = render_map(MapSurface::Mesh(&mesh), &camera, size, Shading::Color).unwrap_err();
    assert!(matches!(error, ViewError::InconsistentSurface { surface: "mesh", .. }));
    for bad in [
        MapCamera { right: Vector3::zeros(), ..camera.clone() },
        MapCamera { position: Vector3::new(f64::NAN, 0.0, 0.0), ..camera.clone() },
        MapCamera { projection: Projection::Orthographic { height_m: 0.0 }, ..camera.clone() },
        MapCamera { projection: Projection::Perspective { vertical_angle_deg: 180.0 }, ..camera },
    ] {
        let error = render_map(MapSurface::Mesh(&room()), &bad, size, Shading::Color).unwrap_err();
        assert!(matches!(error, ViewError::BadCamera { .. }));
    }
}

#[test]
fn degenerate_surfaces_give_pictures() {
    let empty = TriangleMesh::default();
    let mut odd = room();
    odd.positions[3] = [f32::NAN; 3];
    odd.positions[7] = [f32::MAX, f32::MIN, 1e30];
    odd.positions[9] = odd.positions[10];
    let one = PointCloud::from_positions(vec![[1.0, 2.0, 3.0]]);
    let none = PointCloud::default();
    let surfaces =
        [MapSurface::Mesh(&empty), MapSurface::Mesh(&odd), MapSurface::Cloud(&one), MapSurface::Cloud(&none)];
    for surface in surfaces {
        for viewpoint in Viewpoint::ALL {
            let camera = MapCamera::fixed(viewpoint, surface.positions(), None, &Vector3::z(), 4.0 / 3.0);
            for shading in [Shading::Color, Shading::Normals] {
                render_map(surface, &camera, PictureSize::new(320, 240), shading).unwrap();
            }
        }
    }
}
