//! Depth Anything 3: views in, a prediction of depth, confidence and poses out.
//!
//! Written from the behaviour of the official code (Lin et al., *Depth Anything 3: Recovering the Visual Space from Any
//! Views*, 2025) on the layers of `vidar-nn`; every published network runs from its own files.
//!
//! ```no_run
//! use vidar_core::Image;
//! use vidar_da3::{Da3, Da3Options, InferOptions, Inputs};
//! # fn main() -> Result<(), vidar_da3::Da3Error> {
//! let model = Da3::open("DA3-SMALL".as_ref(), &Da3Options::default())?;
//! let images: Vec<Image<[u8; 3]>> = vec![Image::filled(640, 480, [90, 90, 90]); 2];
//! let prediction = model.infer(&Inputs::images(&images), &InferOptions::default())?;
//! let depth = &prediction.depth[0]; // 504 × 378
//! # let _ = depth; Ok(()) }
//! ```
//!
//! The conventions inside are the network's: poses `camera_from_world`, intrinsics with their origin at the *edge* of
//! the top-left pixel ([`pose::to_edge`], [`pose::from_edge`]). [`Da3Model`] uses `VIDAR`'s.

pub mod align;
mod arithmetic;
pub mod check;
pub mod config;
mod da3;
mod device;
mod error;
mod geometry;
#[cfg(feature = "gpu")]
pub mod gpu;
mod image_encoder;
mod infer;
mod memory;
mod model;
pub mod pose;
pub mod preprocess;
pub mod ray_pose;
mod run;
pub mod salad;
mod sky;
mod trace;
pub mod weights;

pub use arithmetic::{Arithmetic, Precision};
pub use config::{Da3Config, Variant};
pub use da3::{Da3, Da3Options, WeightsOrigin};
pub use device::{Device, UnknownDevice};
pub use error::Da3Error;
pub use geometry::{Da3Model, Da3ModelConfig, PoseMode};
pub use image_encoder::{ImageEncoder, ImageTokens};
pub use infer::{FeatureMaps, InferOptions, Inputs, NetOutput, Prediction};
pub use memory::{MemoryEstimate, memory_estimate};
pub use model::DevicePlan;
pub use model::backbone::{Pixels, ReferenceStrategy};
pub use model::metres_per_canonical;
pub use pose::NetCameras;
pub use run::Hooks;
pub use trace::{Layout, Trace, Traced};
pub use vidar_nn::Isa;
pub use weights::Residency;
