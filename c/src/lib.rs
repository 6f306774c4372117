//! VIDAR for C and C++: live odometry and Depth Anything 3, by opaque handles and plain structs.
//!
//! The header `include/vidar.h` is made from these files by cbindgen. Nothing is computed here. Every call that can fail takes a
//! pointer for an error, which the caller frees; a panic is such an error, too. Null pointers are errors, not crashes.

pub mod depth;
pub mod error;
pub mod image;
pub mod odometry;
