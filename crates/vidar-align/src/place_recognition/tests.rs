use super::*;
use vidar_core::{FrameId, Image, Timestamp};

fn direction(seed: u64, n: usize) -> Vec<f32> {
    let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    let mut values: Vec<f32> = (0..n)
        .map(|_| {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 40) as f32 / (1u64 << 23) as f32 - 1.0
        })
        .collect();
    let length = values.iter().map(|v| v * v).sum::<f32>().sqrt();
    values.iter_mut().for_each(|v| *v /= length);
    values
}

fn at(secs: f64) -> Timestamp {
    Timestamp::from_nanos((secs * 1e9) as i64)
}

#[test]
fn a_revisit_is_found_though_hundreds_of_neighbours_look_more_alike() {
    // 20 Hz; every frame looks most like those of the last seconds, then like the place 60 s ago.
    let n = 96;
    let mut index = PlaceIndex::default();
    let look = |i: usize| -> Vec<f32> {
        let (slow, place) = (direction(7, n), direction(100 + (i as u64 % 1200) / 20, n));
        let mixed: Vec<f32> = slow.iter().zip(&place).map(|(a, b)| 0.3 * a + b).collect();
        let length = mixed.iter().map(|v| v * v).sum::<f32>().sqrt();
        mixed.into_iter().map(|v| v / length).collect()
    };
    for i in 0..1300 {
        assert!(index.add(FrameId(i as u32), at(i as f64 / 20.0), i as f64 * 0.05, &look(i)));
    }
    let found = index.search(at(1300.0 / 20.0), 65.0, &look(1300), 5, 10.0, 3.0);
    assert_eq!(found.len(), 5);
    assert!(found.iter().all(|m| (100..120).contains(&m.frame_id.0) && m.similarity > 0.999), "{found:?}");
    let naive = index.search(at(1300.0 / 20.0), 65.0, &look(1300), 5, 0.0, 0.0);
    assert!(naive.iter().any(|m| m.similarity > 0.999 && m.frame_id.0 < 130));
    // Standing still: no travel, no revisit.
    assert!(index.search(at(500.0), 3.1, &look(1300), 5, 10.0, 3.0).iter().all(|m| m.frame_id.0 <= 2));
}

#[test]
fn similarities_are_those_of_the_descriptors_to_four_digits() {
    let mut index = PlaceIndex::default();
    let all: Vec<Vec<f32>> = (0..50).map(|s| direction(s, 333)).collect();
    all.iter().enumerate().for_each(|(i, d)| assert!(index.add(FrameId(i as u32), at(0.0), 0.0, d)));
    for m in index.search(at(1.0), 0.0, &all[9], 50, 0.0, 0.0) {
        let exact: f32 = all[9].iter().zip(&all[m.frame_id.index()]).map(|(a, b)| a * b).sum();
        assert!((exact - m.similarity).abs() < 1e-4);
    }
    assert!(!index.add(FrameId(99), at(0.0), 0.0, &[1.0, 0.0]), "another length");
    let mut broken = all[0].clone();
    broken[5] = f32::NAN;
    assert!(!index.add(FrameId(99), at(0.0), 0.0, &broken));
    assert!(index.search(at(1.0), 0.0, &[1.0], 5, 0.0, 0.0).is_empty());
}

#[test]
fn places_that_share_a_common_look_are_told_apart_once_it_is_removed() {
    // As averaged tokens are: nine tenths of every descriptor is the same, channels differ in size a hundredfold.
    let n = 64;
    let (common, sizes) = (direction(1, n), direction(2, n));
    let look = |place: usize, visit: u64| -> Vec<f32> {
        let (own, noise) = (direction(100 + place as u64, n), direction(5000 + 97 * place as u64 + visit, n));
        let mixed = (0..n).map(|c| {
            let size = if sizes[c] > 0.0 { 1.0 } else { 0.01 };
            common[c] + 0.1 * size * (own[c] + 0.3 * noise[c])
        });
        let mixed: Vec<f32> = mixed.collect();
        let length = mixed.iter().map(|v| v * v).sum::<f32>().sqrt();
        mixed.into_iter().map(|v| v / length).collect()
    };
    let (mut plain, mut whitened) = (PlaceIndex::default(), PlaceIndex::whitened());
    for place in 0..60 {
        let (id, time) = (FrameId(place as u32), at(place as f64));
        if place == 10 {
            assert!(whitened.search(at(100.0), 0.0, &look(3, 1), 5, 10.0, 0.0).is_empty(), "too few places");
        }
        assert!(plain.add(id, time, 0.0, &look(place, 0)) && whitened.add(id, time, 0.0, &look(place, 0)));
    }
    for place in 0..60 {
        let found = whitened.search(at(100.0), 0.0, &look(place, 1), 2, 10.0, 0.0);
        assert_eq!(found[0].frame_id.index(), place);
        // The nearest of sixty strangers in 64 dimensions is still far.
        assert!(found[0].similarity > 0.78 && found[1].similarity < 0.75, "{place}: {found:?}");
        assert!(plain.search(at(100.0), 0.0, &look(place, 1), 60, 10.0, 0.0)[59].similarity > 0.97);
    }
}

fn scene(seed: f32, shift: f32, gain: f32, offset: f32) -> Image<f32> {
    Image::from_fn(160, 120, |x, y| {
        let (x, y) = (x as f32 + shift, y as f32);
        let wave = (x * 0.07 * seed).sin() * (y * 0.05 + seed).cos() + (0.11 * x - 0.13 * y * seed).sin();
        let box_ = if (x - 40.0 * seed).abs() < 15.0 && (y - 30.0 * seed).abs() < 12.0 { 1.5 } else { 0.0 };
        (wave + box_) * gain + offset
    })
}

#[test]
fn an_image_is_recognised_under_other_light_and_a_small_shift_and_other_images_are_not() {
    let like = |a: &Image<f32>, b: &Image<f32>| -> f32 {
        describe_image(a).iter().zip(&describe_image(b)).map(|(x, y)| x * y).sum()
    };
    let first = scene(1.0, 0.0, 40.0, 100.0);
    assert!((like(&first, &scene(1.0, 0.0, 20.0, 60.0)) - 1.0).abs() < 1e-3);
    let near = like(&first, &scene(1.0, 3.0, 40.0, 100.0));
    assert!(near > 0.9, "{near}");
    for other in [1.3, 1.7, 2.2] {
        let far = like(&first, &scene(other, 0.0, 40.0, 100.0));
        assert!(far < 0.75, "{other}: {far}");
    }
    assert_eq!(describe_image(&first).len(), IMAGE_DESCRIPTOR_LEN);
    assert!(describe_image(&Image::filled(160, 120, 5.0)).iter().all(|v| v.is_finite()));
    assert!(describe_image(&Image::filled(3, 3, 5.0)).is_empty());
    assert!(describe_image(&Image::filled(160, 120, f32::NAN)).iter().all(|v| v.is_finite()));
}

#[test]
fn tokens_give_a_unit_descriptor_that_the_strongest_token_does_not_dominate() {
    let quiet: Vec<f32> = (0..30).flat_map(|k| direction(k, 16)).collect();
    let mut loud = quiet.clone();
    loud[..16].iter_mut().for_each(|v| *v *= 1000.0);
    let (a, b) = (describe_tokens(&quiet, 16), describe_tokens(&loud, 16));
    assert!((a.iter().map(|v| v * v).sum::<f32>() - 1.0).abs() < 1e-5);
    assert!(a.iter().zip(&b).all(|(x, y)| (x - y).abs() < 1e-5));
    assert!(describe_tokens(&[f32::NAN; 16], 16).is_empty());
    assert!(describe_tokens(&[], 16).is_empty());
}

#[test]
#[ignore = "takes a second and 100 MB: cargo test -p vidar-align --lib fifty_thousand -- --ignored"]
fn fifty_thousand_places_are_searched_in_a_tenth_of_a_second() {
    let n = 1024;
    let mut index = PlaceIndex::default();
    let rows: Vec<Vec<f32>> = (0..64).map(|s| direction(s, n)).collect();
    (0..50_000).for_each(|i| assert!(index.add(FrameId(i as u32), at(0.0), 0.0, &rows[i % 64])));
    assert!(index.memory_bytes() < 120_000_000);
    let start = std::time::Instant::now();
    let found = index.search(at(100.0), 100.0, &rows[5], 5, 10.0, 3.0);
    assert!(found[0].similarity > 0.999);
    assert!(start.elapsed().as_secs_f64() < 0.5, "{:?}", start.elapsed());
}
