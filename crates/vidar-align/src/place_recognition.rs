//! Places by their looks: descriptors, and an exact search among them.
//!
//! A descriptor is a unit-length vector; two images of one place have an inner product near 1. Where the geometry model has
//! tokens, their mean describes the image ([`describe_tokens`]); where there are only images, [`describe_image`] does it
//! from brightness and gradients on a coarse grid. SALAD's head, for those who have its checkpoint, is
//! [`crate::streaming::SaladHead`].

mod describe;
mod index;

pub use describe::{IMAGE_DESCRIPTOR_LEN, describe_image, describe_tokens};
pub use index::{PlaceIndex, PlaceMatch};

#[cfg(test)]
mod tests;
