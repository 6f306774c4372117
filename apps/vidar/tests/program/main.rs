//! The real program, driven as a user drives it. One binary, so that the tiny synthetic recording is rendered once.

mod config;
mod docs;
mod faults;
mod numbers;
mod support;
mod verbs;
