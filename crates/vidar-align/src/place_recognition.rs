//! Place recognition: image descriptors without a network of their own, and an exact search among descriptors.
//!
//! A descriptor is a unit-length vector; two images of one place have an inner product near 1. It is the mean of a geometry
//! network's tokens ([`describe_tokens`]), or brightness and gradients on a coarse grid ([`describe_image`]), or comes from
//! SALAD (`vidar_da3::salad`); the index does not depend on which.

mod describe;
mod index;

pub use describe::{IMAGE_DESCRIPTOR_LEN, describe_image, describe_tokens};
pub use index::{PlaceIndex, PlaceMatch};

#[cfg(test)]
mod tests;
