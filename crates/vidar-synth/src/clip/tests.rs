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
