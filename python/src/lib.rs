//! VIDAR as a Python module. Nothing is computed here: arguments become values of the libraries, results become NumPy arrays.
//!
//! Long calls release the GIL and look for Ctrl-C ([`call::interruptible`]); errors are exceptions with the codes of the
//! command line ([`error`]).

pub mod arrays;
pub mod call;
pub mod depth;
pub mod error;
pub mod evaluate;
pub mod events;
pub mod odometry;
pub mod options;
pub mod recording;
pub mod rig;
pub mod run;
pub mod surface;
pub mod trajectory;

use pyo3::prelude::*;

/// One camera and an IMU into a metric dense 3-D map.
///
/// Conventions: `a_from_b` maps coordinates in b to coordinates in a; metres, seconds (times are int nanoseconds), radians; the
/// camera looks along z, x right, y down; pixel (0, 0) is the centre of the top-left pixel; depth is z, not ray length.
#[pymodule]
fn vidar(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add("__version__", ::vidar::VERSION)?;
    module.add("VidarError", module.py().get_type::<error::VidarError>())?;
    module.add_class::<events::Frame>()?;
    module.add_class::<events::ImuSample>()?;
    module.add_class::<events::DepthImage>()?;
    module.add_class::<events::GroundTruth>()?;
    module.add_class::<rig::Camera>()?;
    module.add_class::<rig::ImuNoise>()?;
    module.add_class::<recording::Recording>()?;
    module.add_class::<odometry::Odometry>()?;
    module.add_class::<odometry::State>()?;
    module.add_class::<trajectory::Trajectory>()?;
    module.add_class::<trajectory::Alignment>()?;
    module.add_class::<depth::DepthAnything3>()?;
    module.add_class::<depth::DepthPrediction>()?;
    module.add_class::<surface::Mesh>()?;
    module.add_class::<surface::PointCloud>()?;
    module.add_class::<evaluate::Evaluation>()?;
    module.add_class::<run::Run>()?;
    module.add_class::<run::View>()?;
    module.add_function(wrap_pyfunction!(trajectory::align, module)?)?;
    module.add_function(wrap_pyfunction!(surface::fuse, module)?)?;
    module.add_function(wrap_pyfunction!(evaluate::evaluate, module)?)?;
    module.add_function(wrap_pyfunction!(run::run, module)?)?;
    module.add_function(wrap_pyfunction!(run::read_run, module)?)
}
