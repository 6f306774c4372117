//! Depth Anything 3: images in; depth, confidence and cameras out.

use crate::error::{VidarError, guarded, usage};
use crate::image::{VidarImage, text};
use std::ffi::c_char;
use std::ptr;
use vidar::core::{LieGroup, Se3};
use vidar::da3::pose::from_edge;
use vidar::da3::{Da3, Da3Options, InferOptions, Inputs, Precision, Prediction};
use vidar::models::{self, ModelChoice};

/// An open network. Any number of threads may predict with it at once.
pub struct VidarDepthModel {
    network: Da3,
    choice: ModelChoice,
}

/// A prediction of one or more views.
pub struct VidarDepth(Prediction);

/// A camera that was predicted.
#[repr(C)]
pub struct VidarDepthCamera {
    /// Position in the world, in the unit of depth.
    pub position_in_world: [f64; 3],
    /// x, y, z, w; camera: x right, y down, z forward.
    pub world_from_camera_xyzw: [f64; 4],
    /// fx, fy, cx, cy in pixels of the prediction; pixel (0, 0) is the centre of the top-left pixel.
    pub intrinsics: [f64; 4],
}

/// Opens a network by its name in `vidar model list`, or null. "da3-nano" is built in; nothing is fetched.
///
/// # Safety
/// `model` is null or ends in a zero byte; `error` is null or may be written to.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn vidar_depth_open(
    model: *const c_char,
    error: *mut *mut VidarError,
) -> *mut VidarDepthModel {
    let open = || {
        // SAFETY: the caller's promise.
        let choice = ModelChoice::named(unsafe { text("model", model) }?)?;
        // The dense head stays in 32 bits, as in the official program.
        let options = Da3Options { head_precision: Some(Precision::F32), ..Da3Options::default() };
        let network = models::locate(&choice, None, &models::store(true)?)?.open(&options)?;
        Ok(Box::into_raw(Box::new(VidarDepthModel { network, choice })))
    };
    // SAFETY: the caller's promise.
    unsafe { guarded(error, ptr::null_mut(), open) }
}

/// Predicts `count` images together, or null. `process_size` is the longer side of the network's input, px; 0 is the one that it was
/// trained for.
///
/// # Safety
/// `model` was made by vidar_depth_open; `images` points to `count` images whose pixels are there; `error` is null or may be written to.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn vidar_depth_predict(
    model: *const VidarDepthModel,
    images: *const VidarImage,
    count: usize,
    process_size: usize,
    error: *mut *mut VidarError,
) -> *mut VidarDepth {
    let predict = || {
        // SAFETY: the caller's promise.
        let model = unsafe { model.as_ref() }.ok_or_else(|| usage("model is null"))?;
        if images.is_null() || count == 0 {
            return Err(usage("there are no images"));
        }
        // SAFETY: the caller's promise.
        let images = unsafe { std::slice::from_raw_parts(images, count) };
        // SAFETY: the caller's promise.
        let images = images.iter().map(|image| unsafe { image.rgb() }).collect::<Result<Vec<_>, _>>()?;
        let mut options = InferOptions::default();
        options.preprocess.process_size_px = match process_size {
            0 => models::process_size_px(&model.choice),
            size => size,
        };
        let prediction = model.network.infer(&Inputs::images(&images), &options)?;
        Ok(Box::into_raw(Box::new(VidarDepth(prediction))))
    };
    // SAFETY: the caller's promise.
    unsafe { guarded(error, ptr::null_mut(), predict) }
}

/// Columns of the maps.
///
/// # Safety
/// `depth` was made by vidar_depth_predict.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn vidar_depth_width(depth: *const VidarDepth) -> usize {
    // SAFETY: the caller's promise.
    unsafe { depth.as_ref() }.map_or(0, |d| d.0.width())
}

/// Rows of the maps.
///
/// # Safety
/// `depth` was made by vidar_depth_predict.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn vidar_depth_height(depth: *const VidarDepth) -> usize {
    // SAFETY: the caller's promise.
    unsafe { depth.as_ref() }.map_or(0, |d| d.0.height())
}

/// Whether depth is in metres; else one unknown factor is common to all views.
///
/// # Safety
/// `depth` was made by vidar_depth_predict.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn vidar_depth_is_metric(depth: *const VidarDepth) -> bool {
    // SAFETY: the caller's promise.
    unsafe { depth.as_ref() }.is_some_and(|d| d.0.is_metric)
}

/// z-depth of a view, row by row, or null. Valid until the prediction is freed.
///
/// # Safety
/// `depth` was made by vidar_depth_predict.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn vidar_depth_map(depth: *const VidarDepth, view: usize) -> *const f32 {
    // SAFETY: the caller's promise.
    let map = unsafe { depth.as_ref() }.and_then(|d| d.0.depth.get(view));
    map.map_or(ptr::null(), |m| m.data().as_ptr())
}

/// Confidence of a view, row by row: at least 1, only comparisons mean something; null for networks of single views. Valid until
/// the prediction is freed.
///
/// # Safety
/// `depth` was made by vidar_depth_predict.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn vidar_depth_confidence(depth: *const VidarDepth, view: usize) -> *const f32 {
    // SAFETY: the caller's promise.
    let map = unsafe { depth.as_ref() }.and_then(|d| d.0.confidence.as_ref()?.get(view));
    map.map_or(ptr::null(), |m| m.data().as_ptr())
}

/// Writes the camera of a view; false where there is none.
///
/// # Safety
/// `depth` was made by vidar_depth_predict; `camera` is null or may be written to.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn vidar_depth_camera(
    depth: *const VidarDepth,
    view: usize,
    camera: *mut VidarDepthCamera,
) -> bool {
    // SAFETY: the caller's promise.
    let found = unsafe { depth.as_ref() }.and_then(|d| camera_of(&d.0, view));
    match found {
        Some(found) if !camera.is_null() => {
            // SAFETY: the caller's promise.
            unsafe { camera.write(found) };
            true
        }
        _ => false,
    }
}

fn camera_of(prediction: &Prediction, view: usize) -> Option<VidarDepthCamera> {
    let pose = Se3::from_matrix(prediction.camera_from_world.as_ref()?.get(view)?)?.inverse();
    let matrix = prediction.intrinsics.as_ref()?.get(view)?;
    let pinhole = from_edge(matrix, prediction.width(), prediction.height())?;
    Some(VidarDepthCamera {
        position_in_world: pose.translation.into(),
        world_from_camera_xyzw: pose.rotation.quaternion_xyzw(),
        intrinsics: [pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy],
    })
}

/// Frees a prediction; null is allowed.
///
/// # Safety
/// `depth` is null or was made by vidar_depth_predict and is not freed yet.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn vidar_depth_free(depth: *mut VidarDepth) {
    if !depth.is_null() {
        // SAFETY: the caller's promise.
        drop(unsafe { Box::from_raw(depth) });
    }
}

/// Closes a network; null is allowed. Its predictions stay valid.
///
/// # Safety
/// `model` is null or was made by vidar_depth_open and is not closed yet.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn vidar_depth_close(model: *mut VidarDepthModel) {
    if !model.is_null() {
        // SAFETY: the caller's promise.
        drop(unsafe { Box::from_raw(model) });
    }
}
