//! The numbered examples run; each checks its own result.

#[path = "../examples/04_align_chunks.rs"]
mod align_chunks;
#[path = "../examples/05_fuse_and_mesh.rs"]
mod fuse_and_mesh;
#[path = "../examples/03_predict_depth.rs"]
mod predict_depth;
#[path = "../examples/01_read_dataset.rs"]
mod read_dataset;
#[path = "../examples/02_run_odometry.rs"]
mod run_odometry;

#[test]
fn example_01_reads_every_image_and_imu_sample_that_was_written() {
    read_dataset::main().unwrap();
}

#[test]
fn example_02_estimates_a_metric_trajectory() {
    run_odometry::main().unwrap();
}

#[test]
fn example_03_predicts_depth_within_three_per_cent() {
    predict_depth::main().unwrap();
}

#[test]
fn example_04_aligns_chunks_in_one_metric_world() {
    align_chunks::main().unwrap();
}

#[test]
fn example_05_fuses_a_surface_that_matches_the_scan() {
    fuse_and_mesh::main().unwrap();
}
