//! Distances from one file of points to another: the program that `bench/nn_vs_scipy.py` times.
//!
//! `nearest_files QUERY.f32 REFERENCE.f32 DISTANCES.f32 THREADS ROUNDS`; files hold little-endian `f32`, three a
//! point. Prints one JSON object with seconds of each round and peak memory.

#![allow(clippy::unwrap_used, clippy::panic, clippy::print_stdout)] // a measuring program: stops at the first surprise, prints

mod process;

use process::{peak_mib, processor_secs};
use std::time::Instant;
use vidar_eval::{NearestIndex, nearest_distances};

fn points(path: &str) -> Vec<[f32; 3]> {
    let bytes = std::fs::read(path).unwrap();
    let number = |b: &[u8]| f32::from_le_bytes(b.try_into().unwrap());
    bytes.chunks_exact(12).map(|p| [number(&p[..4]), number(&p[4..8]), number(&p[8..])]).collect()
}

fn main() {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let [query, reference, out, threads, rounds] = args.as_slice() else {
        panic!("usage: nearest_files QUERY.f32 REFERENCE.f32 DISTANCES.f32 THREADS ROUNDS");
    };
    let (query, reference) = (points(query), points(reference));
    let given = peak_mib();
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads.parse().unwrap()).build().unwrap();
    let (mut build, mut search, mut processor) = (Vec::new(), Vec::new(), Vec::new());
    let mut distances = Vec::new();
    for _ in 0..rounds.parse::<usize>().unwrap() {
        let before = processor_secs();
        let start = Instant::now();
        let index = pool.install(|| NearestIndex::build(&reference)).unwrap();
        build.push(start.elapsed().as_secs_f64());
        let start = Instant::now();
        distances = pool.install(|| nearest_distances(&query, &index, None));
        search.push(start.elapsed().as_secs_f64());
        processor.push(processor_secs() - before);
    }
    let bytes: Vec<u8> = distances.iter().flat_map(|d| d.to_le_bytes()).collect();
    let peak = peak_mib();
    std::fs::write(out, bytes).unwrap();
    println!(
        "{{\"build\": {build:?}, \"query\": {search:?}, \"processor\": {processor:?}, \
         \"points_mib\": {given:.1}, \"peak_mib\": {peak:.1}}}"
    );
}
