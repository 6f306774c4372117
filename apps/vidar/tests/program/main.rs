//! The real program, driven as a user drives it. One binary, so that the tiny synthetic recording is rendered once.
// Helpers of tests are tests: they stop at the first surprise and say loudly what they skip.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::print_stderr)]

mod auto;
mod batch;
mod bench;
mod budget;
mod calibrate;
mod compare;
mod config;
mod convert;
mod coupling;
mod damage;
mod docs;
mod fault_list;
mod faults;
mod hostile;
mod keys;
mod ladder;
mod link;
mod live;
mod map;
mod masks;
mod mcap_file;
mod models;
mod numbers;
mod odometry;
mod photos;
mod quality;
mod recordings;
mod release;
mod resume;
mod schedulers;
mod support;
mod trust;
mod verbs;
mod view;
