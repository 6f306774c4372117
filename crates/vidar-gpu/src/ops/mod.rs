//! Operations on device memory, recorded one by one.

mod attention;
mod convolution;
mod elementwise;
mod matmul;
mod norm;
mod resample;

pub use attention::{AttendSpec, Rotation, attend, prepare_heads};
pub use convolution::{Convolution, MapShape, Spread, convolve, spread};
pub use elementwise::{Activation, PointLayer, add, copy_rows, patchify, point};
pub use matmul::{End, Rows, product, product_into};
pub use norm::{Norm, layer_norm};
pub use resample::{Grid, embed, resample};

pub(crate) use matmul::every_kernel as matmul_kernels;

use crate::kernel::Kernel;

/// Every shader text that this crate can send to a device, for checks without one.
pub fn every_shader() -> Vec<(String, String)> {
    let all: Vec<Kernel> = [
        matmul_kernels(),
        attention::every_kernel(),
        norm::every_kernel(),
        elementwise::every_kernel(),
        resample::every_kernel(),
    ]
    .into_iter()
    .flatten()
    .collect();
    all.iter().map(|kernel| (kernel.name.clone(), kernel.source())).collect()
}

/// Workgroups for `items` invocations in groups of `size`, folded where one dimension is too short.
pub(crate) fn groups(items: usize, size: usize) -> [u32; 3] {
    const FOLD: usize = 32768;
    let all = items.div_ceil(size);
    if all <= FOLD { [all as u32, 1, 1] } else { [FOLD as u32, all.div_ceil(FOLD) as u32, 1] }
}
