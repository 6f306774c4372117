//! What a chunk may hold beside its depth, as arrays: another model's depth, masks, and what poses are known to.

use crate::error::Error;
use vidar_core::Image;
use vidar_export::official::{NpyArray, NpyData};
use vidar_stereo::PoseStd;

/// Name of the array of another model's depth.
pub(super) const SHAPES: &str = "shape";
/// Name of the array of standard deviations of corrected poses: rotation, rad, and translation, m.
pub(super) const POSE_STD: &str = "pose_std";
/// Name of the array of what is not to be used.
pub(super) const MASKS: &str = "masked";

/// One image per view at the size of the first; NaN where a view has none.
pub(super) fn pack_shapes(shapes: &[Option<Image<f32>>], n: usize) -> Result<Option<NpyArray>, Error> {
    let Some(first) = shapes.iter().flatten().next().filter(|_| shapes.len() == n) else { return Ok(None) };
    let (width, height) = (first.width(), first.height());
    let empty = Image::filled(width, height, f32::NAN);
    let of_size = |s: &Option<Image<f32>>| match s {
        Some(image) if (image.width(), image.height()) == (width, height) => image.data().to_vec(),
        _ => empty.data().to_vec(),
    };
    let values = shapes.iter().flat_map(of_size).collect();
    Ok(Some(NpyArray::new(vec![n, height, width], NpyData::F32(values))?))
}

/// As [`pack_shapes`] wrote them; images of NaN alone are none.
pub(super) fn unpack_shapes(array: NpyArray, n: usize) -> Vec<Option<Image<f32>>> {
    let (height, width) = match array.shape[..] {
        [found, height, width] if found == n && height * width > 0 => (height, width),
        _ => return Vec::new(),
    };
    let values = array.into_f32().unwrap_or_default();
    let image = |v: &[f32]| {
        let image = Image::from_vec(width, height, v.to_vec()).ok()?;
        image.data().iter().any(|z| z.is_finite()).then_some(image)
    };
    values.chunks(width * height).map(image).collect()
}

/// One image of 0 and 1 per view; `None` where there is no mask.
pub(super) fn pack_masks(
    masks: &[Option<Image<bool>>],
    shape: [usize; 3],
) -> Result<Option<NpyArray>, Error> {
    let [n, height, width] = shape;
    if masks.len() != n || masks.iter().all(Option::is_none) {
        return Ok(None);
    }
    let of_size = |mask: &Option<Image<bool>>| match mask {
        Some(mask) if (mask.width(), mask.height()) == (width, height) => {
            mask.data().iter().map(|m| u8::from(*m)).collect()
        }
        _ => vec![0; width * height],
    };
    let values = masks.iter().flat_map(of_size).collect();
    Ok(Some(NpyArray::new(shape.to_vec(), NpyData::U8(values))?))
}

/// As [`pack_masks`] wrote them; images of zeros alone are none.
pub(super) fn unpack_masks(array: NpyArray, shape: [usize; 3]) -> Vec<Option<Image<bool>>> {
    let [_, height, width] = shape;
    let NpyData::U8(values) = array.data else { return Vec::new() };
    if array.shape != shape || height * width == 0 {
        return Vec::new();
    }
    let image = |v: &[u8]| {
        let image = Image::from_vec(width, height, v.iter().map(|m| *m != 0).collect()).ok()?;
        image.data().contains(&true).then_some(image)
    };
    values.chunks(width * height).map(image).collect()
}

/// Rotation, rad, and translation, m, of each of `n` views; `None` where not all are known.
pub(super) fn pack_pose_std(pose_std: &[PoseStd], n: usize) -> Result<Option<NpyArray>, Error> {
    if pose_std.len() != n || n == 0 {
        return Ok(None);
    }
    let values = pose_std.iter().flat_map(|s| [s.rotation_rad, s.translation_m]).collect();
    Ok(Some(NpyArray::new(vec![n, 2], NpyData::F64(values))?))
}

/// As [`pack_pose_std`] wrote them; none of another number.
pub(super) fn unpack_pose_std(array: NpyArray, n: usize) -> Vec<PoseStd> {
    match array.data {
        NpyData::F64(values) if values.len() == 2 * n => {
            let one = |v: &[f64; 2]| PoseStd { rotation_rad: v[0], translation_m: v[1] };
            values.as_chunks::<2>().0.iter().map(one).collect()
        }
        _ => Vec::new(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_poses_are_known_to_comes_back_or_not_at_all() {
        let stds = [(0.001, 0.002), (0.5, 0.25)].map(|(r, t)| PoseStd { rotation_rad: r, translation_m: t });
        let array = pack_pose_std(&stds, 2).unwrap().unwrap();
        assert_eq!(unpack_pose_std(array.clone(), 2), stds);
        assert!(unpack_pose_std(array, 3).is_empty());
        assert!(pack_pose_std(&stds, 3).unwrap().is_none() && pack_pose_std(&[], 0).unwrap().is_none());
    }

    #[test]
    fn shapes_come_back_with_the_same_bits_and_holes() {
        let image = Image::from_fn(5, 4, |x, y| if x == y { f32::NAN } else { 0.1 + (x * y) as f32 });
        let shapes = vec![Some(image.clone()), None, Some(image.map(|z| 2.0 * z))];
        let array = pack_shapes(&shapes, 3).unwrap().unwrap();
        assert_eq!(array.shape, [3, 4, 5]);
        let bits = |s: &Option<Image<f32>>| {
            s.as_ref().map(|i| i.data().iter().map(|z| z.to_bits()).collect::<Vec<_>>())
        };
        let read = unpack_shapes(array.clone(), 3);
        assert_eq!(read.iter().map(bits).collect::<Vec<_>>(), shapes.iter().map(bits).collect::<Vec<_>>());
        // Of another number of views, or of none.
        assert!(unpack_shapes(array, 2).is_empty());
        assert!(pack_shapes(&shapes, 2).unwrap().is_none() && pack_shapes(&[None], 1).unwrap().is_none());
    }

    #[test]
    fn masks_come_back_and_those_of_another_size_are_not_read() {
        let mask = Image::from_fn(5, 4, |x, y| x > y);
        let masks = vec![None, Some(mask.clone()), None];
        let array = pack_masks(&masks, [3, 4, 5]).unwrap().unwrap();
        assert_eq!(unpack_masks(array.clone(), [3, 4, 5]), masks);
        assert!(unpack_masks(array, [3, 5, 4]).is_empty());
        assert!(pack_masks(&[None, None], [2, 4, 5]).unwrap().is_none());
    }
}
