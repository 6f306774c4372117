//! Every operation against a naive reference in f64.

#[path = "../common/mod.rs"]
mod common;
mod elementwise;
mod head;
mod products;
