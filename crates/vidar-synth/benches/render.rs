//! How fast worlds are built and views are rendered (items per second are rays per second).

use divan::counter::ItemsCount;
use vidar_synth::{
    FlightPath, SynthConfig, SynthView, World, euroc_body_from_camera, euroc_camera, render_views,
};

fn main() {
    divan::main();
}

fn world() -> (FlightPath, World) {
    let config = SynthConfig::demo();
    let built =
        FlightPath::built_in(&config).and_then(|path| World::build(&config, &path).map(|w| (path, w)));
    match built {
        Ok(pair) => pair,
        Err(error) => unreachable!("the demo's own configuration: {error}"),
    }
}

#[divan::bench(sample_count = 5)]
fn build_demo_world() -> usize {
    world().1.shape_count()
}

#[divan::bench(args = [1, 3], sample_count = 20)]
fn render_demo_frame(bencher: divan::Bencher<'_, '_>, samples: usize) {
    let (path, world) = world();
    let Ok(camera) = euroc_camera(376, 240) else { return };
    let view = SynthView { world_from_camera: path.world_from_body(2.0) * euroc_body_from_camera(), camera };
    bencher
        .counter(ItemsCount::new(376 * 240 * samples))
        .bench_local(|| render_views(&world, std::slice::from_ref(&view), samples));
}
