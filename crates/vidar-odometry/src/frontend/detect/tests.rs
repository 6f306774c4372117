use super::*;
use crate::frontend::testbed::scene;
use vidar_core::testing::same_with_each_instruction_set;

fn detect(config: DetectorConfig, taken: impl Fn(&mut OccupancyGrid)) -> Vec<Detection> {
    let pyramid = scene().pyramid(0);
    let mut detector = Detector::new(config);
    let mut grid = detector.grid(pyramid.width(), pyramid.height());
    taken(&mut grid);
    let mut found = Vec::new();
    detector.detect(&pyramid, &grid, &mut found);
    found
}

#[test]
fn a_room_has_features_everywhere_and_at_most_one_a_cell() {
    let config = DetectorConfig::default();
    let found = detect(config.clone(), |_| {});
    assert!(found.len() > 40, "{}", found.len());
    let mut grid = OccupancyGrid::new(376, 240, config.cell_px);
    for d in &found {
        assert!(grid.take(&d.pixel), "two in a cell: {d:?}");
        let border = (BORDER_PX as f64 - 1.0) * level_scale(d.level.into());
        assert!(d.pixel.x >= border && d.pixel.y >= border);
        assert!(d.pixel.x < 376.0 - border && d.pixel.y < 240.0 - border);
        match d.kind {
            FeatureKind::Corner => assert!(d.strength >= MIN_CORNER_STRENGTH),
            FeatureKind::Edgelet { normal } => {
                assert!((normal.norm() - 1.0).abs() < 1e-9 && d.strength >= MIN_EDGE_STRENGTH);
            }
        }
    }
    let corners = found.iter().take_while(|d| d.kind == FeatureKind::Corner).count();
    assert!(found[corners..].iter().all(|d| d.kind != FeatureKind::Corner), "corners come first");
    assert!(found[..corners].is_sorted_by(|a, b| a.strength >= b.strength));
}

#[test]
fn taken_cells_are_left_alone() {
    let before = detect(DetectorConfig::default(), |_| {});
    let taken: Vec<Pixel> = before.iter().step_by(2).map(|d| d.pixel).collect();
    let after = detect(DetectorConfig::default(), |grid| taken.iter().for_each(|p| assert!(grid.take(p))));
    let expected: Vec<_> = before.iter().skip(1).step_by(2).collect();
    assert_eq!(after.iter().collect::<Vec<_>>(), expected);
}

#[test]
fn features_are_the_same_on_every_path() {
    let run = || detect(DetectorConfig::default(), |_| {});
    assert!(!same_with_each_instruction_set(run).is_empty());
}

#[test]
fn an_edge_without_corners_gives_edgelets_with_its_normal() {
    let image = Image::from_fn(320, 240, |x, y| {
        let across = (0.8 * x as f64 + 0.6 * y as f64 - 200.0) / 1.5;
        (120.0 + 60.0 * across.tanh()) as u8
    });
    let pyramid = Pyramid::of(&image, 4);
    let mut detector = Detector::new(DetectorConfig::default());
    let grid = detector.grid(320, 240);
    let mut found = Vec::new();
    detector.detect(&pyramid, &grid, &mut found);
    assert!(found.len() >= 4, "{found:?}");
    for d in &found {
        let FeatureKind::Edgelet { normal } = d.kind else { panic!("a corner on an edge: {d:?}") };
        assert!(normal.dot(&Vector2::new(0.8, 0.6)).abs() > 0.99, "{d:?}");
        assert!((0.8 * d.pixel.x + 0.6 * d.pixel.y - 200.0).abs() < 3.0, "{d:?}");
    }
    let flat = Pyramid::of(&Image::filled(320, 240, 50), 4);
    detector.detect(&flat, &grid, &mut found);
    assert!(found.is_empty());
}

#[test]
fn the_same_places_are_found_again_in_the_next_image() {
    let scene = scene();
    let mut again = 0;
    let mut tried = 0;
    let next: Vec<Pixel> = scene.features(1).iter().map(|(f, ..)| f.pixel).collect();
    for (feature, ..) in scene.features(0).iter().filter(|(f, ..)| !f.is_edgelet()) {
        let Some(truth) = scene.truth(0, 1, &feature.pixel) else { continue };
        tried += 1;
        again += usize::from(next.iter().any(|p| (p - truth).norm() < 2.5));
    }
    eprintln!("{again} of {tried} corners found again");
    assert!(again * 10 > tried * 3, "{again} of {tried}");
}
