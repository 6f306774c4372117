//! Sub-volumes move with their chunks, and double walls disappear.

mod snapshots;

use crate::common::{Vec3, ball, border_edges, config, floor, fuse, look_at, point, rms, view, views_around};
use vidar_core::{AlignedView, ChunkId, FrameId, Image, LieGroup, Se3, Sim3, So3, TriangleMesh};
use vidar_fusion::{DoubleWallDetector, FusionConfig, FusionError, RevisedView, SubVolumeConfig, SubVolumes};

fn settings(fusion: FusionConfig) -> SubVolumeConfig {
    SubVolumeConfig { fusion, ..SubVolumeConfig::default() }
}

/// The views dealt out to chunks in turn.
fn dealt(config: &SubVolumeConfig, views: &[AlignedView], chunks: u32) -> SubVolumes {
    let mut volumes = SubVolumes::new(config).unwrap();
    for (i, view) in views.iter().enumerate() {
        volumes.integrate(ChunkId(i as u32 * chunks / views.len() as u32), view).unwrap();
    }
    volumes
}

fn add(volumes: &mut SubVolumes, chunk: ChunkId, views: &[AlignedView]) {
    for view in views {
        volumes.integrate(chunk, view).unwrap();
    }
}

fn same_bits(a: &TriangleMesh, b: &TriangleMesh) -> bool {
    let bits = |m: &TriangleMesh| -> Vec<u32> {
        m.positions.iter().chain(&m.normals).flatten().chain(&m.confidences).map(|v| v.to_bits()).collect()
    };
    bits(a) == bits(b) && a.triangles == b.triangles && a.colors == b.colors
}

fn revised(view: &AlignedView, by: &Sim3) -> RevisedView {
    RevisedView {
        frame_id: view.frame_id(),
        world_from_camera: by.transform_pose(view.world_from_camera()),
        depth_factor: by.scale,
    }
}

fn colored(view: AlignedView) -> AlignedView {
    let shade = (view.frame_id().0 * 13 % 256) as u8;
    view.with_color(Image::filled(crate::common::WIDTH, crate::common::HEIGHT, [shade, 100, 255 - shade]))
        .unwrap()
}

#[test]
fn without_motion_the_merged_volume_equals_plain_fusion_to_the_bit() {
    // 130 views: more than the rows of sums take without a carry.
    let views: Vec<AlignedView> = views_around(130, 1.3, ball(0.4)).into_iter().map(colored).collect();
    let fusion = FusionConfig { carve_range_m: 2.0, min_observations: 2, voxel_size_m: 0.04, ..config() };
    let plain = fuse(&fusion, &views);
    for chunks in [1, 4, 130] {
        let mut volumes = dealt(&settings(fusion.clone()), &views, chunks);
        assert_eq!(volumes.chunks().count(), chunks as usize);
        let merged = volumes.merged().unwrap();
        assert_eq!(merged.views(), plain.views());
        assert!(same_bits(&merged.extract_mesh(), &plain.extract_mesh()), "{chunks} chunks");
    }
}

#[test]
fn a_motion_below_the_tolerance_changes_nothing_and_does_not_accumulate() {
    let views = views_around(12, 1.3, ball(0.4));
    let mut volumes = dealt(&settings(config()), &views, 2);
    let before = volumes.extract_mesh().unwrap();
    let mut stale = Vec::new();
    for step in 1..=4 {
        let shift = Sim3::from_se3(&Se3::from_translation(Vec3::new(0.008 * f64::from(step), 0.0, 0.0)));
        let moves: Vec<_> = views[..6].iter().map(|v| revised(v, &shift)).collect();
        let revision = volumes.revise(ChunkId(0), &moves).unwrap();
        assert!((revision.moved_m - 0.008 * f64::from(step)).abs() < 1e-9, "relative to the fused pose");
        stale.push(revision.stale);
        let unchanged = same_bits(&before, &volumes.extract_mesh().unwrap());
        assert_eq!(unchanged, !revision.stale, "step {step}");
    }
    // The tolerance is a voxel of 2 cm.
    assert_eq!(stale, [false, false, true, true]);
    let back: Vec<_> = views[..6].iter().map(|v| revised(v, &Sim3::IDENTITY)).collect();
    assert!(!volumes.revise(ChunkId(0), &back).unwrap().stale);
    assert!(same_bits(&before, &volumes.extract_mesh().unwrap()));
}

#[test]
fn a_moved_chunk_lies_at_its_similarity() {
    let views: Vec<AlignedView> = views_around(40, 1.3, ball(0.4)).into_iter().map(colored).collect();
    let turn = So3::exp(&Vec3::new(0.2, -0.3, 0.5));
    let motion = Sim3::new(turn, Vec3::new(0.313, -0.127, 0.055), 1.05).unwrap();
    let mut volumes = dealt(&settings(config()), &views, 1);
    let moves: Vec<_> = views.iter().map(|v| revised(v, &motion)).collect();
    let revision = volumes.revise(ChunkId(0), &moves).unwrap();
    assert!(revision.stale && revision.bent_m < 1e-6, "{revision:?}");
    let mesh = volumes.extract_mesh().unwrap();
    let off = |p: &[f32; 3]| (point(*p) - motion.translation).norm() - 0.4 * 1.05;
    let moved = rms(mesh.positions.iter().map(off));
    let fused = rms(fuse(&config(), &views).extract_mesh().positions.iter().map(|p| point(*p).norm() - 0.4));
    // Resampling costs less than a tenth of a voxel (2 cm) on top of what fusion itself is off.
    assert!(moved < 1.05 * fused + 0.002, "moved {moved} m, fused {fused} m");
    assert!(border_edges(&mesh).is_empty(), "the ball stays closed");
    let outward = mesh.positions.iter().zip(&mesh.normals);
    assert!(
        outward.into_iter().all(|(p, n)| (point(*p) - motion.translation).normalize().dot(&point(*n)) > 0.9)
    );
    assert!(mesh.confidences.iter().all(|c| *c > 0.95) && mesh.colors.len() == mesh.positions.len());
}

/// Views of the floor z = 0 from a row of positions, 1.2 m up, by a camera whose pose estimate is `drift` too high.
fn floor_views(first: u32, count: u32, from_x: f64, drift: f64) -> Vec<AlignedView> {
    (0..count)
        .map(|i| {
            let eye = Vec3::new(from_x + 1.2 * f64::from(i) / f64::from(count), 0.0, 1.2);
            let truth = look_at(eye, eye + Vec3::new(0.2, 0.0, -1.2));
            let seen = view(first + i, truth, 1.0, floor(0.0));
            let drifted = Se3::new(truth.rotation, truth.translation + Vec3::new(0.0, 0.0, drift));
            crate::common::from_depth(
                first + i,
                drifted,
                seen.depth().image().clone(),
                seen.confidence().image().clone(),
            )
        })
        .collect()
}

fn undrifted(view: &AlignedView, drift: f64) -> RevisedView {
    let pose = view.world_from_camera();
    let translation = pose.translation - Vec3::new(0.0, 0.0, drift);
    RevisedView {
        frame_id: view.frame_id(),
        world_from_camera: Se3::new(pose.rotation, translation),
        depth_factor: 1.0,
    }
}

#[test]
fn a_loop_correction_removes_the_double_wall() {
    let drift = 0.12;
    // The second visit has more views: what a few views observe as free would be carved away.
    let (first, second) = (floor_views(0, 8, 0.0, 0.0), floor_views(100, 24, 0.1, drift));
    let mut volumes = SubVolumes::new(&settings(config())).unwrap();
    add(&mut volumes, ChunkId(0), &first);
    add(&mut volumes, ChunkId(7), &second);
    let detector = DoubleWallDetector::default();
    let rate = |volumes: &mut SubVolumes| detector.of_mesh(&volumes.extract_mesh().unwrap()).unwrap().rate;
    let before = rate(&mut volumes);
    assert!(before > 0.45, "the second visit lies above the first: {before}");

    let moves: Vec<_> = second.iter().map(|v| undrifted(v, drift)).collect();
    let revision = volumes.revise(ChunkId(7), &moves).unwrap();
    assert!((revision.moved_m - drift).abs() < 1e-9 && revision.bent_m < 1e-9 && revision.stale);
    assert_eq!(volumes.stale().iter().map(|(id, _)| *id).collect::<Vec<_>>(), [ChunkId(7)]);
    let moved = rate(&mut volumes);
    assert!(moved < 0.01, "moved: {moved}");
    let height = rms(volumes.extract_mesh().unwrap().positions.iter().map(|p| f64::from(p[2])));
    assert!(height < 0.004, "{height}");

    volumes.rebuild(ChunkId(7), floor_views(100, 24, 0.1, 0.0)).unwrap();
    assert!(volumes.stale().is_empty() && rate(&mut volumes) < 0.01);
    assert_eq!(volumes.report().rebuilt, 1);
    // Fused again where it is, the map is as if it never had been elsewin_memory.
    let all: Vec<AlignedView> = first.into_iter().chain(floor_views(100, 24, 0.1, 0.0)).collect();
    assert!(same_bits(&volumes.extract_mesh().unwrap(), &fuse(&config(), &all).extract_mesh()));
}

#[test]
fn a_non_rigid_motion_is_reported_and_removed_by_fusing_again() {
    // The pose estimates of the chunk's later views are higher and higher: no similarity corrects that.
    let tilt = |i: usize| 0.03 * i as f64;
    let straight = floor_views(0, 8, 0.0, 0.0);
    let bent: Vec<AlignedView> = (0..8).map(|i| floor_views(0, 8, 0.0, tilt(i)).swap_remove(i)).collect();
    let mut volumes = dealt(&settings(config()), &bent, 1);
    let moves: Vec<_> = bent.iter().enumerate().map(|(i, v)| undrifted(v, tilt(i))).collect();
    let revision = volumes.revise(ChunkId(0), &moves).unwrap();
    assert!(revision.moved_m > 0.2 && revision.bent_m > 0.005, "{revision:?}");
    assert!(revision.bent_m < 0.7 * revision.moved_m, "the similarity explains a part: {revision:?}");
    volumes.rebuild(ChunkId(0), straight.clone()).unwrap();
    assert!(same_bits(&volumes.extract_mesh().unwrap(), &fuse(&config(), &straight).extract_mesh()));
}

#[test]
fn views_added_after_a_move_lie_at_their_poses() {
    let views = floor_views(0, 8, 0.0, 0.12);
    let mut volumes = SubVolumes::new(&settings(config())).unwrap();
    add(&mut volumes, ChunkId(0), &views[..5]);
    let moves: Vec<_> = views[..5].iter().map(|v| undrifted(v, 0.12)).collect();
    volumes.revise(ChunkId(0), &moves).unwrap();
    // These have corrected poses.
    add(&mut volumes, ChunkId(0), &floor_views(0, 8, 0.0, 0.0)[5..]);
    let mesh = volumes.extract_mesh().unwrap();
    assert!(rms(mesh.positions.iter().map(|p| f64::from(p[2]))) < 0.004);
    assert_eq!(volumes.merged().unwrap().views(), 8);
}

#[test]
fn a_moved_chunk_carves_at_its_present_pose() {
    // A floater above the floor, observed by one chunk; the other, once moved, observes free space there.
    let fusion = FusionConfig { carve_range_m: 3.0, ..config() };
    let eye = Vec3::new(0.3, 0.0, 1.6);
    let pose = look_at(eye, Vec3::new(0.3, 0.001, 0.0));
    let floater = view(500, pose, 0.3, |o, d| {
        let t = (0.7 - o.z) / d.z;
        let p = o + d * t;
        (p.x - 0.3).hypot(p.y).le(&0.15).then_some(t)
    });
    let far = Vec3::new(40.0, 0.0, 0.0);
    let clear: Vec<AlignedView> = (0..12)
        .map(|i| {
            let eye = Vec3::new(0.05 * f64::from(i), 0.1, 1.9) + far;
            view(i, look_at(eye, eye + Vec3::new(0.0, 0.001, -1.9)), 1.0, floor(0.0))
        })
        .collect();
    let mut volumes = SubVolumes::new(&settings(fusion)).unwrap();
    volumes.integrate(ChunkId(0), &floater).unwrap();
    add(&mut volumes, ChunkId(1), &clear);
    let floats = |volumes: &mut SubVolumes| {
        volumes.extract_mesh().unwrap().positions.iter().filter(|p| p[2] > 0.5 && p[2] < 0.9).count()
    };
    assert!(floats(&mut volumes) > 50);
    // A quarter turn and a shift that is no whole number of blocks.
    let turn = So3::from_axis_angle(&Vec3::z(), 0.7);
    let middle = Vec3::new(0.3, 0.0, 0.0);
    let to = Sim3::new(turn, middle - turn * (middle + far), 1.0).unwrap();
    let moves: Vec<_> = clear.iter().map(|v| revised(v, &to)).collect();
    assert!(volumes.revise(ChunkId(1), &moves).unwrap().stale);
    assert_eq!(floats(&mut volumes), 0, "free space of the moved chunk is carved");
}

#[test]
fn each_keyframe_is_fused_once_and_only_by_its_owner() {
    let views = views_around(4, 1.3, ball(0.4));
    let mut volumes = SubVolumes::new(&settings(config())).unwrap();
    volumes.integrate(ChunkId(1), &views[0]).unwrap();
    volumes.integrate(ChunkId(1), &views[1]).unwrap();
    let rejected =
        |chunk| FusionError::FusedAlready { frame: FrameId(0), owner: ChunkId(1), chunk: ChunkId(chunk) };
    for chunk in [1, 2] {
        assert_eq!(volumes.integrate(ChunkId(chunk), &views[0]).unwrap_err(), rejected(chunk));
    }
    assert_eq!((volumes.owner(FrameId(0)), volumes.owner(FrameId(3))), (Some(ChunkId(1)), None));
    volumes.integrate(ChunkId(2), &views[2]).unwrap();
    let stay = |i: usize| revised(&views[i], &Sim3::IDENTITY);
    assert_eq!(volumes.revise(ChunkId(9), &[]).unwrap_err(), FusionError::NoSuchChunk { chunk: ChunkId(9) });
    let foreign = volumes.revise(ChunkId(1), &[stay(2)]).unwrap_err();
    assert_eq!(foreign, FusionError::NotOfChunk { frame: FrameId(2), chunk: ChunkId(1) });
    for factor in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        let bad = volumes.revise(ChunkId(1), &[RevisedView { depth_factor: factor, ..stay(0) }]).unwrap_err();
        assert_eq!(bad, FusionError::BadMove { frame: FrameId(0), chunk: ChunkId(1) });
    }
    let before = volumes.extract_mesh().unwrap();
    assert_eq!(volumes.rebuild(ChunkId(2), vec![views[0].clone()]).unwrap_err(), rejected(2));
    let twice = vec![views[2].clone(), views[2].clone()];
    assert!(matches!(volumes.rebuild(ChunkId(2), twice), Err(FusionError::FusedAlready { .. })));
    assert!(volumes.rebuild(ChunkId(9), Vec::new()).is_err());
    assert!(same_bits(&before, &volumes.extract_mesh().unwrap()), "a failed rebuild changes nothing");
    // A chunk may be fused again from other views; those it had before are free again.
    volumes.rebuild(ChunkId(2), vec![views[3].clone()]).unwrap();
    assert_eq!((volumes.owner(FrameId(2)), volumes.owner(FrameId(3))), (None, Some(ChunkId(2))));
    assert_eq!(volumes.report().views, 3);
}

#[test]
fn all_chunks_together_hold_to_one_budget() {
    let budget = 3 << 20;
    let fusion = FusionConfig { memory_budget_bytes: budget, voxel_size_m: 0.01, ..config() };
    let mut volumes = SubVolumes::new(&settings(fusion)).unwrap();
    for (i, view) in views_around(30, 1.3, ball(0.4)).iter().enumerate() {
        volumes.integrate(ChunkId(i as u32 / 3), view).unwrap();
        assert!(volumes.memory_bytes() <= budget);
    }
    let report = volumes.report();
    assert!(report.dropped_by_budget > 0 && report.peak_memory_bytes <= budget, "{report:?}");
    assert!(volumes.warnings().iter().any(|w| w.kind == "fusion-memory-budget"));
    assert!(volumes.merged().unwrap().memory_bytes() <= budget);
    let bad = SubVolumeConfig { move_tolerance_voxels: f64::NAN, ..SubVolumeConfig::default() };
    assert!(matches!(
        SubVolumes::new(&bad),
        Err(FusionError::BadConfig { field: "move_tolerance_voxels", .. })
    ));
}

#[test]
fn the_map_is_the_same_for_any_number_of_threads_and_order_of_chunks() {
    let views: Vec<AlignedView> = views_around(24, 1.3, ball(0.4)).into_iter().map(colored).collect();
    let fusion = FusionConfig { carve_range_m: 2.0, ..config() };
    let mesh = |threads: usize, order: [u32; 3]| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let mut volumes = SubVolumes::new(&settings(fusion.clone())).unwrap();
            for chunk in order {
                for view in &views[8 * chunk as usize..8 * chunk as usize + 8] {
                    volumes.integrate(ChunkId(chunk), view).unwrap();
                }
            }
            for chunk in order {
                let axis = Vec3::new(0.01, 0.02, 0.03) * f64::from(chunk);
                let by = Sim3::new(So3::exp(&axis), axis * 2.0, 1.0 + 0.01 * f64::from(chunk)).unwrap();
                let moves: Vec<_> = views[8 * chunk as usize..8 * chunk as usize + 8]
                    .iter()
                    .map(|v| revised(v, &by))
                    .collect();
                volumes.revise(ChunkId(chunk), &moves).unwrap();
            }
            volumes.extract_mesh().unwrap()
        })
    };
    let one = mesh(1, [0, 1, 2]);
    assert!(one.positions.len() > 1000);
    assert!(same_bits(&one, &mesh(4, [0, 1, 2])));
    assert!(same_bits(&one, &mesh(3, [2, 0, 1])));
}
