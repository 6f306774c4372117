//! Nearest-neighbour distances agree with Open3D's to 1e-6 (golden made by `tools/make_open3d_golden.py`).

use serde_json::Value;
use vidar_eval::{NearestIndex, nearest_distances};

/// The generator of the golden's script: numbers k/2²⁴ in [0, 1).
fn uniform(seed: u64, n: usize) -> Vec<f32> {
    let mut state = seed;
    let mut next = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 40) as f32 / (1 << 24) as f32
    };
    (0..n).map(|_| next()).collect()
}

fn points(set: &Value) -> Vec<[f32; 3]> {
    let (kind, seed) = (set["kind"].as_str().unwrap(), set["seed"].as_u64().unwrap());
    let u = uniform(seed, 3 * set["count"].as_u64().unwrap() as usize);
    let shape = |u: &[f32]| match kind {
        "volume" => [u[0] * 8.0, u[1] * 8.0, u[2] * 8.0],
        "plane" => [u[0] * 8.0, u[1] * 4.0, 1.5],
        "lattice" => [(u[0] * 32.0).floor() / 8.0, (u[1] * 32.0).floor() / 8.0, (u[2] * 2.0).floor() / 8.0],
        other => panic!("unknown kind {other}"),
    };
    u.chunks_exact(3).map(shape).collect()
}

#[test]
fn distances_are_open3ds_to_a_micrometre_also_on_planes_and_duplicates() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data/open3d_nearest.json");
    let golden: Value = serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap();
    let cases = golden["cases"].as_array().unwrap();
    assert_eq!(cases.len(), 5);
    for case in cases {
        let index = NearestIndex::build(&points(&case["reference"])).unwrap();
        let distances = nearest_distances(&points(&case["query"]), &index, None);
        let what = format!("{} to {}", case["query"], case["reference"]);
        for (i, expected) in case["first"].as_array().unwrap().iter().enumerate() {
            let (ours, expected) = (f64::from(distances[i]), expected.as_f64().unwrap());
            assert!((ours - expected).abs() <= 1e-6, "{what}: point {i} is {ours}, Open3D says {expected}");
        }
        let sum: f64 = distances.iter().map(|&d| f64::from(d)).sum();
        let mean_error = (sum - case["sum"].as_f64().unwrap()).abs() / distances.len() as f64;
        assert!(mean_error <= 1e-6, "{what}: mean differs by {mean_error}");
        let max = f64::from(distances.iter().copied().fold(0.0, f32::max));
        assert!((max - case["max"].as_f64().unwrap()).abs() <= 1e-6, "{what}: max is {max}");
    }
}
