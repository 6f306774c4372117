//! Randomized places and homes differ from seed to seed in everything, and nothing stands in the flight's way.

use vidar_core::{FrameImage, Se3};
use vidar_synth::{
    FlightKind, SceneKind, Simulation, SynthConfig, SynthView, Variety, euroc_body_from_camera, euroc_camera,
    render_views,
};

fn wild(seed: u64, scene: SceneKind, flight: FlightKind) -> Simulation {
    varied(seed, Variety::Randomized, scene, flight)
}

fn varied(seed: u64, variety: Variety, scene: SceneKind, flight: FlightKind) -> Simulation {
    let config = SynthConfig {
        seed,
        scene,
        flight,
        variety,
        width: 64,
        height: 40,
        duration_secs: 6.0,
        ..SynthConfig::default()
    };
    Simulation::new(&config, None).unwrap()
}

/// A picture from the middle of the flight.
fn picture(simulation: &Simulation) -> Vec<u8> {
    let world_from_camera: Se3 = simulation.path().world_from_body(3.0) * euroc_body_from_camera();
    let view = SynthView { world_from_camera, camera: euroc_camera(64, 40).unwrap() };
    match render_views(simulation.world(), &[view], 1).unwrap().swap_remove(0).image {
        FrameImage::Gray8(image) => image.into_vec(),
        other => panic!("{other:?}"),
    }
}

#[test]
fn flights_are_free_in_every_wild_place_and_home() {
    let scenes = [SceneKind::Room, SceneKind::Hall, SceneKind::Corridor];
    let flights = [FlightKind::Sweep, FlightKind::Orbit, FlightKind::Aggressive];
    for seed in 0..9 {
        for variety in [Variety::Randomized, Variety::Home] {
            let simulation = varied(seed, variety, scenes[seed as usize % 3], flights[seed as usize / 3]);
            for position in simulation.path().positions(0.05) {
                let clearance = simulation.world().clearance_m(&position);
                assert!(clearance >= 0.25, "{variety:?}, seed {seed}: {clearance} m");
                assert_eq!(simulation.world().extent().distance(&position), 0.0);
            }
        }
    }
}

#[test]
fn places_differ_in_size_light_and_taste() {
    let places: Vec<Simulation> = (0..8).map(|seed| wild(seed, SceneKind::Room, FlightKind::Sweep)).collect();
    let range = |value: &dyn Fn(&Simulation) -> f64| {
        let values: Vec<f64> = places.iter().map(value).collect();
        let low = values.iter().copied().fold(f64::INFINITY, f64::min);
        let high = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        high / low
    };
    let size = |k: usize| move |s: &Simulation| (s.world().extent().max - s.world().extent().min)[k];
    for (k, least) in [(0, 1.5), (1, 1.5), (2, 1.25)] {
        assert!(range(&size(k)) > least, "axis {k}: {}", range(&size(k)));
    }
    let mean = |s: &Simulation| picture(s).iter().map(|v| f64::from(*v)).sum::<f64>() / (64.0 * 40.0);
    assert!(range(&mean) > 1.6, "brightness {}", range(&mean));
    assert!(range(&|s| s.world().shape_count() as f64) > 1.3);
}

#[test]
fn the_same_seed_is_the_same_place_on_any_number_of_threads() {
    let on = |threads: usize, seed: u64| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| picture(&wild(seed, SceneKind::Hall, FlightKind::Orbit)))
    };
    assert_eq!(on(1, 5), on(4, 5));
    assert_ne!(on(4, 5), on(4, 6));
}
