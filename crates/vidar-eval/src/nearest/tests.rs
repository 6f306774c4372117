use super::*;
use proptest::prelude::*;
use vidar_core::random::SplitMix64;

fn brute_force(query: &[f32; 3], points: &[[f32; 3]]) -> f64 {
    let squared = |p: &[f32; 3]| -> f64 {
        p.iter().zip(query).map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2)).sum()
    };
    points.iter().map(squared).fold(f64::INFINITY, f64::min).sqrt()
}

#[track_caller]
fn assert_exact(points: &[[f32; 3]], queries: &[[f32; 3]]) {
    let index = NearestIndex::build(points).unwrap();
    for (query, distance) in queries.iter().zip(nearest_distances(queries, &index, None)) {
        let expected = brute_force(query, points);
        assert!((f64::from(distance) - expected).abs() <= 1e-6 * expected.max(1.0), "{query:?}: {distance}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn distances_are_those_of_brute_force(
        points in prop::collection::vec(prop::array::uniform3(-5.0_f32..5.0), 1..300),
        queries in prop::collection::vec(prop::array::uniform3(-8.0_f32..8.0), 1..60),
    ) {
        assert_exact(&points, &queries);
    }

    #[test]
    fn coordinates_that_often_coincide_change_nothing(
        points in prop::collection::vec(prop::array::uniform3(0_u8..4), 1..400),
        queries in prop::collection::vec(prop::array::uniform3(-1.0_f32..5.0), 1..40),
    ) {
        let points: Vec<[f32; 3]> = points.iter().map(|p| p.map(f32::from)).collect();
        assert_exact(&points, &queries);
    }
}

#[test]
fn planes_lines_and_one_place_a_thousandfold_are_ordinary_input() {
    let grid: Vec<[f32; 3]> = (0..10_000).map(|i| [(i % 100) as f32, (i / 100) as f32, 2.0]).collect();
    let queries: Vec<[f32; 3]> =
        (0..300).map(|i| [i as f32 * 0.37, i as f32 * 0.21, i as f32 * 0.01]).collect();
    assert_exact(&grid, &queries);
    let line: Vec<[f32; 3]> = (0..5_000).map(|i| [1.0, i as f32 * 0.01, -3.0]).collect();
    assert_exact(&line, &queries);
    assert_exact(&vec![[0.5, 0.5, 0.5]; 5_000], &queries);
}

#[test]
fn the_answer_names_the_point_that_was_given() {
    let points: Vec<[f32; 3]> = (0..1000).map(|i| [(i * 7 % 1000) as f32, 0.0, 0.0]).collect();
    let index = NearestIndex::build(&points).unwrap();
    for (i, p) in points.iter().enumerate() {
        let found = index.nearest(&[p[0] + 0.2, 0.0, 0.0], None).unwrap();
        assert_eq!(found.index as usize, i);
        assert_eq!(found.position, *p);
    }
    let all = index.nearest_all(&points, None);
    assert!(
        all.iter().enumerate().all(|(i, n)| n.is_some_and(|n| n.index as usize == i && n.distance_m == 0.0))
    );
}

#[test]
fn the_largest_distance_is_strict_and_beyond_it_is_infinity() {
    let index = NearestIndex::build(&[[0.0; 3], [10.0, 0.0, 0.0]]).unwrap();
    let queries = [[1.0, 0.0, 0.0], [0.5, 0.0, 0.0], [4.0, 0.0, 0.0], [10.0, 0.0, 0.25]];
    let limited = nearest_distances(&queries, &index, Some(1.0));
    assert_eq!(limited, [f32::INFINITY, 0.5, f32::INFINITY, 0.25]);
    assert_eq!(nearest_distances(&queries, &index, None), [1.0, 0.5, 4.0, 0.25]);
}

#[test]
fn unusable_points_are_left_out_and_unusable_queries_find_nothing() {
    let index =
        NearestIndex::build(&[[f32::NAN, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, f32::INFINITY, 0.0]]).unwrap();
    assert_eq!((index.len(), index.dropped()), (1, 2));
    assert_eq!(index.nearest(&[0.0; 3], None).unwrap().index, 1);
    let distances = nearest_distances(&[[f32::NAN; 3], [0.0; 3]], &index, None);
    assert!(distances[0].is_nan() && distances[1] == 1.0);
    let empty = NearestIndex::build(&[]).unwrap();
    assert!(empty.is_empty() && empty.bounds().is_none());
    assert_eq!(nearest_distances(&[[0.0; 3]], &empty, None), [f32::INFINITY]);
    assert!(nearest_distances(&[], &index, None).is_empty());
}

#[test]
fn coordinates_at_the_end_of_the_range_neither_panic_nor_win() {
    let index = NearestIndex::build(&[[f32::MAX, 0.0, 0.0], [1e30, 0.0, 0.0], [2.0, 0.0, 0.0]]).unwrap();
    assert_eq!((index.len(), index.dropped()), (2, 1));
    assert_eq!(index.nearest(&[0.0; 3], None).map(|n| (n.index, n.distance_m)), Some((2, 2.0)));
    let far = NearestIndex::build(&[[1e30, 0.0, 0.0]]).unwrap();
    // The square of such a distance is beyond single precision.
    assert_eq!(far.nearest(&[0.0; 3], None), None);
}

#[test]
fn one_thread_and_four_give_the_same_bits() {
    let mut random = SplitMix64::new(5);
    let mut next = || 4.0 * random.uniform() as f32;
    // Enough points for the parallel build, enough queries for several tasks.
    let mut points: Vec<[f32; 3]> = (0..20_000).map(|_| [next(), next(), 0.125]).collect();
    // Equal points are equally near; which of them is named must not depend on threads either.
    points.extend_from_within(..5_000);
    let queries: Vec<[f32; 3]> = (0..20_000).map(|_| [next(), next(), next()]).collect();
    let with = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| NearestIndex::build(&points).unwrap().nearest_all(&queries, None))
    };
    assert_eq!(with(1), with(4));
}

#[test]
fn followed_neighbours_are_those_of_a_new_search_wherever_the_query_goes() {
    let points: Vec<[f32; 3]> = (0..4000)
        .map(|i| [(i % 63) as f32 * 0.05, (i / 63) as f32 * 0.05, (i as f32 * 0.7).sin() * 0.01])
        .collect();
    let index = NearestIndex::build(&points).unwrap();
    let mut known = Followed::NEW;
    // Small steps along the surface, a leap, metres away from it, and back.
    for step in 0..2000 {
        let t = step as f32;
        let height = if step % 500 < 400 { 0.02 } else { 3.0 };
        let query = [1.5 + (t * 0.001).sin(), 1.5 + (t * 0.0013).cos(), height];
        let followed = index.follow(&query, &mut known).unwrap();
        assert_eq!(followed.0, index.nearest(&query, None).unwrap().distance_m, "step {step}");
    }
    assert_eq!(index.follow(&[f32::NAN; 3], &mut known), None);
    let mut unknown = Followed::NEW;
    assert_eq!(NearestIndex::build(&[]).unwrap().follow(&[0.0; 3], &mut unknown), None);
}

#[test]
fn a_following_query_seldom_needs_a_search() {
    let points: Vec<[f32; 3]> = (0..2500).map(|i| [(i % 50) as f32, (i / 50) as f32, 0.0]).collect();
    let index = NearestIndex::build(&points).unwrap();
    let mut known = Followed::NEW;
    index.follow(&[20.1, 20.0, 0.1], &mut known).unwrap();
    let searched = known;
    index.follow(&[20.2, 20.1, 0.1], &mut known).unwrap();
    assert_eq!(known, searched, "the nearest is still the same, by far");
    index.follow(&[20.6, 20.1, 0.1], &mut known).unwrap();
    assert_ne!(known, searched);
}

#[test]
fn no_point_is_lost_between_leaves() {
    for count in [1, 15, 16, 17, 33, 1000, 4097] {
        let points: Vec<[f32; 3]> = (0..count)
            .map(|i| [(i * 7919 % 613) as f32, (i * 104_729 % 31) as f32, (i / 7) as f32])
            .collect();
        let index = NearestIndex::build(&points).unwrap();
        let (min, max) = index.bounds().unwrap();
        let expected = bounds_of(points.iter());
        assert_eq!((min, max), expected, "{count}");
        assert_eq!(index.len(), count);
        // Every point is found at its own place: none is lost between the leaves.
        for p in &points {
            assert_eq!(index.nearest(p, None).unwrap().distance_m, 0.0);
        }
    }
}
