//! Tests of clips.

use super::*;

fn settings() -> ClipSettings {
    ClipSettings { views: 4, width: 56, height: 42, samples: 2 }
}

#[test]
fn a_clip_follows_from_its_rooms_seed_and_number() {
    let room = ClipRoom::new(Split::Validation, 3, 56).unwrap();
    let again = ClipRoom::new(Split::Validation, 3, 56).unwrap();
    let (a, b) = (room.clip(1, &settings()).unwrap(), again.clip(1, &settings()).unwrap());
    let other = room.clip(2, &settings()).unwrap();
    for (a, b) in a.views.iter().zip(&b.views) {
        assert_eq!(a.image.data(), b.image.data());
        assert_eq!(a.world_from_camera, b.world_from_camera);
    }
    assert_ne!(a.views[0].image.data(), other.views[0].image.data());
}

#[test]
fn splits_share_no_seed() {
    let seeds = [Split::Train, Split::Validation, Split::Test].map(|s| [s.seed(0), s.seed(u32::MAX)]);
    assert!(seeds.windows(2).all(|w| w[0][1] < w[1][0]) && seeds[0][0] > 1_000_000);
}

#[test]
fn neighbouring_views_show_much_of_the_same_surface() {
    let mut shares = Vec::new();
    for index in 0..4 {
        let room = ClipRoom::new(Split::Validation, index, 56).unwrap();
        for number in 0..3 {
            let clip = room.clip(number, &settings()).unwrap();
            for pair in clip.views.windows(2) {
                shares.push(shared(&clip.camera, &pair[0], &pair[1]));
            }
        }
    }
    shares.sort_by(f64::total_cmp);
    let median = shares[shares.len() / 2];
    assert!(median > 0.6, "half of the pairs share less than {median}");
}

/// Share of `a`'s pixels whose surface `b` sees at the depth that it should have there.
fn shared(camera: &Pinhole, a: &ClipView, b: &ClipView) -> f64 {
    let b_from_a = b.world_from_camera.inverse() * a.world_from_camera;
    let (mut seen, mut all) = (0, 0);
    for y in 0..camera.height {
        for x in 0..camera.width {
            let z = f64::from(*a.depth.get(x, y).unwrap());
            let ray =
                Vector3::new((x as f64 - camera.cx) / camera.fx, (y as f64 - camera.cy) / camera.fy, 1.0);
            let p = b_from_a.act(&(ray * z));
            let (u, v) = (camera.fx * p.x / p.z + camera.cx, camera.fy * p.y / p.z + camera.cy);
            all += 1;
            if p.z > 0.0 && u > -0.5 && v > -0.5 {
                let there = b.depth.get(u.round() as usize, v.round() as usize);
                seen += usize::from(there.is_some_and(|d| (f64::from(*d) - p.z).abs() < 0.1 * p.z));
            }
        }
    }
    f64::from(seen as u32) / f64::from(all)
}

#[test]
fn settings_outside_their_domain_are_refused() {
    let room = ClipRoom::new(Split::Test, 0, 56).unwrap();
    for bad in [
        ClipSettings { views: 0, ..settings() },
        ClipSettings { samples: 65, ..settings() },
        ClipSettings { width: 3, ..settings() },
    ] {
        assert!(room.clip(0, &bad).is_err());
    }
}

#[test]
fn homes_take_only_their_share_and_change_no_other_room() {
    assert!(ClipRoom::with_homes(Split::Train, 0, 56, 1.5).is_err());
    let mut homes = 0;
    for index in 0..6 {
        let mixed = ClipRoom::with_homes(Split::Train, index, 56, 0.5).unwrap();
        if mixed.is_home {
            homes += 1;
            continue;
        }
        let usual = ClipRoom::new(Split::Train, index, 56).unwrap();
        let [a, b] = [&mixed, &usual].map(|room| room.clip(0, &settings()).unwrap());
        assert!(a.views.iter().zip(&b.views).all(|(a, b)| a.image.data() == b.image.data()));
    }
    assert!((1..6).contains(&homes), "{homes} of 6");
}

#[test]
fn homes_are_small_full_and_seen_from_near_by_and_above() {
    let (mut depths, mut tilts) = (Vec::new(), Vec::new());
    for index in 0..5 {
        let room = ClipRoom::with_homes(Split::Train, index, 56, 1.0).unwrap();
        let extent = room.simulation.world().extent();
        let size = extent.max - extent.min;
        assert!(size.x < 7.0 && size.y < 7.0 && size.z < 3.1, "{size:?}");
        assert!(room.simulation.world().shape_count() > 40, "{}", room.simulation.world().shape_count());
        for number in 0..6 {
            for view in room.clip(number, &settings()).unwrap().views {
                let mut seen: Vec<f32> =
                    view.depth.data().iter().copied().filter(|d| d.is_finite()).collect();
                seen.sort_by(f32::total_cmp);
                depths.push(seen[seen.len() / 2]);
                tilts.push((view.world_from_camera.rotation * Vector3::z()).z);
            }
        }
    }
    let middle = |values: &mut Vec<f32>| {
        values.sort_by(f32::total_cmp);
        values[values.len() / 2]
    };
    assert!((0.8..2.2).contains(&middle(&mut depths)), "median depth {} m", middle(&mut depths));
    let down = tilts.iter().filter(|z| **z < -0.25).count();
    assert!(3 * down > tilts.len(), "{down} of {} look down", tilts.len());
}
