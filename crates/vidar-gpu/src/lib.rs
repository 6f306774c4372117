//! Device operations of the networks: compute shaders written in WGSL, run through `wgpu` on Vulkan, Metal or DirectX 12.
//!
//! The counterpart of `vidar-nn` on a graphics processor. Numbers are `f32` in device memory, row-major; feature maps are
//! NHWC; weights lie in `f32`, or packed by two in bf16 or f16. Sums are always `f32`. A [`Gpu`] is an open device,
//! [`Buffer`]s are its memory, a [`Recorder`] takes operations ([`ops`]) and sends them off together.
//!
//! Nothing here panics on what a device does: memory that runs out, a device that is lost and a shader that it refuses are
//! [`GpuError`]s. Sizes that do not fit are the caller's own doing and asserted, as in `vidar-nn`.
//!
//! Everything stands behind the feature `device`; without it this crate is empty.

#![cfg_attr(not(feature = "device"), allow(rustdoc::broken_intra_doc_links))]
#![cfg(feature = "device")]
#![forbid(unsafe_code)]

mod adapter;
mod buffer;
mod device;
mod error;
mod kernel;
pub mod ops;
mod recorder;
mod weight;

pub use adapter::{Adapter, AdapterKind, GpuOptions, adapters, find};
pub use buffer::Buffer;
pub use device::Gpu;
pub use error::GpuError;
pub use recorder::Recorder;
pub use weight::{Matrix, Storage};
