use super::*;
use vidar_core::{FrameId, LandmarkId, So3, Timestamp};
use vidar_solve::pcg64::Pcg64;

/// A room of points with descriptors, seen by a keyframe of the map and by a query from elsewhere.
struct Scene {
    map: Vec<Arc<MapKeyframe>>,
    query: Query,
    map_from_own: Se3,
}

fn uniform(random: &mut Pcg64) -> f64 {
    (random.next_u64() >> 11) as f64 / (1_u64 << 53) as f64 - 0.5
}

/// `flipped` bits of every descriptor differ between the two views; own distances are `scale` times too long.
fn scene(flipped: u32, scale: f64) -> Scene {
    let mut random = Pcg64::seed(11);
    let map_from_own = Se3::new(So3::exp(&(Vector3::z() * -0.8)), Vector3::new(3.0, 1.0, 0.2));
    let (keyframe_at, query_at) = (Vector3::new(0.2, 0.1, 1.2), Vector3::new(-1.1, -2.4, 1.0));
    let (mut points, mut features) = (Vec::new(), Vec::new());
    for k in 0..60 {
        let in_map = Vector3::new(
            2.0 + uniform(&mut random),
            4.0 * uniform(&mut random),
            2.0 * uniform(&mut random) + 1.0,
        );
        let words = [0; 4].map(|_: u64| random.next_u64());
        let key = Some(TrackKey { generation: 0, track: LandmarkId(k) });
        points.push(MapPoint {
            key,
            in_camera: in_map - keyframe_at,
            descriptor: Descriptor::from_words(words),
            at_octaves: Vec::new(),
        });
        let mut seen_words = words;
        for _ in 0..flipped {
            let bit = (random.next_u64() % 256) as usize;
            seen_words[bit / 64] ^= 1 << (bit % 64);
        }
        let from_query = map_from_own.inverse().act(&in_map) - query_at;
        features.push(QueryFeature {
            ray: from_query.normalize(),
            distance: Some(scale * from_query.norm()),
            descriptors: vec![Descriptor::from_words(seen_words)],
            pixel: Pixel::new(f64::from(k), 7.0),
            covariance: Matrix2::identity(),
        });
    }
    let keyframe = MapKeyframe {
        own: Some((FrameId(3), FrameId(3))),
        time: Timestamp::from_nanos(0),
        segment: 0,
        world_from_camera: Se3::from_translation(keyframe_at),
        points,
    };
    let query =
        Query { segment: 1, position: query_at, features, ray_sigma_rad: 2e-3, max_scale_difference: 0.2 };
    Scene { map: vec![Arc::new(keyframe)], query, map_from_own }
}

#[test]
fn a_place_seen_again_gives_the_turn_and_shift_between_the_worlds() {
    let Scene { map, query, map_from_own } = scene(30, 1.03);
    let found = relocalize(&query, &map).unwrap();
    assert_eq!((found.segment, found.matches.len()), (0, 60));
    let error = found.map_from_own.inverse() * map_from_own;
    assert!(error.log().norm() < 1e-6, "{error:?}");
    assert!(
        found.matches.iter().all(|m| f64::from(m.key.track.0) == m.pixel.x),
        "each with its own landmark"
    );
    assert!(found.agrees_with(&found, 1.0));
    let elsewhere = Relocalized {
        map_from_own: Se3::from_translation(Vector3::new(0.0, 0.6, 0.0)) * found.map_from_own,
        ..found.clone()
    };
    assert!(!found.agrees_with(&elsewhere, 1.0), "60 cm aside is another place");
}

#[test]
fn what_looks_different_or_is_of_another_size_or_of_the_own_segment_is_not_found() {
    let Scene { map, query, .. } = scene(200, 1.0);
    assert!(relocalize(&query, &map).is_none(), "descriptors with half of their bits flipped");
    let Scene { map, query, .. } = scene(30, 1.4);
    assert!(relocalize(&query, &map).is_none(), "a world 1.4 times too large");
    let Scene { map, query, .. } = scene(30, 1.0);
    assert!(relocalize(&Query { segment: 0, ..query }, &map).is_none(), "the own segment");
}

#[test]
fn a_map_forgets_what_came_late_and_moves_segments_into_one_world() {
    let keyframe = |frame: u32, segment: u32| {
        let points = scene(0, 1.0).map[0].points.clone();
        let time = Timestamp::from_nanos(i64::from(frame));
        let own = Some((FrameId(frame), FrameId(frame)));
        MapKeyframe { own, time, segment, world_from_camera: Se3::IDENTITY, points }
    };
    let mut map = KeyframeMap::default();
    (0..4).for_each(|k| map.add(keyframe(k, k / 2)));
    map.add(MapKeyframe { points: Vec::new(), ..keyframe(9, 1) });
    assert_eq!(map.keyframes().len(), 4, "a keyframe that shows nothing is not kept");
    assert!(map.has_other_than(0) && map.has_other_than(1));
    let shift = Se3::from_translation(Vector3::new(1.0, 0.0, 0.0));
    map.join(1, 0, &shift, 1.0);
    assert!(!map.has_other_than(0));
    assert_eq!(map.keyframes()[3].world_from_camera.translation.x, 1.0);
    assert_eq!(map.keyframes()[0].world_from_camera.translation.x, 0.0);
    map.revise(FrameId(0), shift);
    assert_eq!(map.keyframes()[0].world_from_camera.translation.x, 1.0);
    map.forget_after(Timestamp::from_nanos(1));
    assert_eq!(map.keyframes().len(), 2);
}

#[test]
fn a_saved_map_is_the_same_place() {
    let Scene { map, query, map_from_own } = scene(30, 1.0);
    let saved = SavedMap::new(map.iter().map(AsRef::as_ref));
    assert_eq!((saved.len(), saved.is_empty(), saved.fault()), (1, false, None));
    let read = saved.as_segment(0);
    let found = relocalize(&query, read.keyframes()).unwrap();
    assert!((found.map_from_own.inverse() * map_from_own).log().norm() < 1e-5);
    assert!(
        found.inliers == 60 && found.matches.is_empty(),
        "landmarks of another recording have no tracks here"
    );
    assert!(SavedMap::default().fault().unwrap().contains("version 0"));
}

#[test]
fn most_images_say_where_the_world_lies_in_the_map() {
    let Scene { map, query, .. } = scene(30, 1.0);
    let found = relocalize(&query, &map).unwrap();
    let moved = |x: f64, turn: f64| {
        let by = Se3::new(So3::exp(&(Vector3::z() * turn)), Vector3::new(x, 0.0, 0.0));
        let about_camera = Se3::from_translation(found.map_from_own.act(&found.position));
        let map_from_own = about_camera * by * about_camera.inverse() * found.map_from_own;
        Relocalized { map_from_own, ..found.clone() }
    };
    let all = [moved(0.9, 0.0), moved(0.02, 0.01), moved(-0.02, -0.01), moved(0.0, 0.0)];
    let place = consensus(&all, false).unwrap();
    assert_eq!(place.inliers, 3 * found.inliers, "one of four is elsewhere");
    let error = found.map_from_own.inverse() * place.map_from_own;
    assert!(error.log().norm() < 1e-9, "{error:?}");
    assert!(consensus(&all[..2], false).is_none(), "no two agree");
    assert!(consensus(&[], false).is_none());
}
