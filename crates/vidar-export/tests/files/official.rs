//! The official program's files: read from numpy, written for it, and compared with its numbers.

use serde_json::Value;
use std::collections::BTreeMap;
use std::io::Cursor;
use vidar_core::Image;
use vidar_export::official::*;

/// The prediction of `tools/make_npz_golden.py`.
fn known() -> Prediction {
    let (n, h, w) = (2, 3, 4);
    let view = |v: usize| {
        let index = move |x: usize, y: usize| (v * h + y) * w + x;
        let mut extrinsics = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
        extrinsics[0][3] = if v == 1 { -0.25 } else { 0.0 };
        PredictedView {
            image: Some(Image::from_fn(w, h, |x, y| {
                std::array::from_fn(|c| ((index(x, y) * 3 + c) * 7 % 256) as u8)
            })),
            depth: Image::from_fn(w, h, |x, y| 0.5 + index(x, y) as f32 / 8.0),
            confidence: Some(Image::from_fn(w, h, |x, y| {
                let value = 1.0 + index(x, y) as f32 / 3.0;
                (value * 100.0).round_ties_even() / 100.0
            })),
            extrinsics: Some(extrinsics),
            intrinsics: Some([[5.0, 0.0, 2.0], [0.0, 6.0, 1.5], [0.0, 0.0, 1.0]]),
        }
    };
    Prediction { views: (0..n).map(view).collect() }
}

fn numpy_file() -> Vec<u8> {
    std::fs::read(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data/numpy_prediction.npz")).unwrap()
}

fn read(bytes: &[u8]) -> Result<Prediction, vidar_export::ExportError> {
    read_prediction_npz(Cursor::new(bytes), NpzLimits { bytes: 1 << 20, arrays: 16 })
}

fn written(write: impl FnOnce(&mut Cursor<Vec<u8>>)) -> Vec<u8> {
    let mut cursor = Cursor::new(Vec::new());
    write(&mut cursor);
    cursor.into_inner()
}

#[test]
fn files_of_numpy_are_read() {
    assert_eq!(read(&numpy_file()).unwrap(), known());
}

#[test]
fn written_predictions_are_restored() {
    let whole = written(|w| write_npz(w, &known()).unwrap());
    assert_eq!(read(&whole).unwrap(), known());
    let mini = written(|w| write_mini_npz(w, &known()).unwrap());
    let mut without = known();
    without.views.iter_mut().for_each(|v| v.image = None);
    assert_eq!(read(&mini).unwrap(), without);
    assert!(mini.len() < whole.len());
    let mut bare = without;
    for view in &mut bare.views {
        (view.confidence, view.extrinsics, view.intrinsics) = (None, None, None);
    }
    assert_eq!(read(&written(|w| write_mini_npz(w, &bare).unwrap())).unwrap(), bare);
    assert!(write_npz(Cursor::new(Vec::new()), &bare).unwrap_err().to_string().contains("mini_npz"));
}

#[test]
fn other_names_and_square_matrices_are_accepted() {
    let array = |shape: &[usize], data| NpyArray::new(shape.to_vec(), data).unwrap();
    let depth = array(&[1, 1, 2], NpyData::F64(vec![1.0, 2.0]));
    let square: Vec<f32> = (0..16).map(|i| i as f32).collect();
    let exts = array(&[1, 4, 4], NpyData::F32(square));
    let ixts = array(&[1, 3, 3], NpyData::F32(vec![1.0; 9]));
    let arrays = [("depth", &depth), ("exts", &exts), ("ixts", &ixts)];
    let view = read(&written(|w| write_npz_arrays(w, &arrays).unwrap())).unwrap().views.remove(0);
    assert_eq!(view.extrinsics.unwrap()[2], [8.0, 9.0, 10.0, 11.0]);
    assert_eq!(view.intrinsics.unwrap(), [[1.0; 3]; 3]);
    assert_eq!(view.depth.data(), [1.0, 2.0]);
}

#[test]
fn contradictions_are_reported() {
    let floats = |shape: &[usize]| {
        NpyArray::new(shape.to_vec(), NpyData::F32(vec![1.0; shape.iter().product()])).unwrap()
    };
    let depth = floats(&[2, 3, 4]);
    for (name, shape) in [
        ("conf", &[2, 4, 3][..]),
        ("conf", &[24]),
        ("image", &[2, 3, 4, 3]),
        ("extrinsics", &[1, 3, 4]),
        ("extrinsics", &[2, 2, 4]),
        ("intrinsics", &[2, 4, 3]),
    ] {
        let other = floats(shape);
        let bytes = written(|w| write_npz_arrays(w, &[("depth", &depth), (name, &other)]).unwrap());
        assert!(read(&bytes).unwrap_err().to_string().contains(name), "{name} {shape:?}");
    }
    let other = floats(&[2]);
    assert!(read(&written(|w| write_npz_arrays(w, &[("other", &other)]).unwrap())).is_err());
    for shape in [&[2, 3][..], &[0, 3, 4], &[usize::MAX, 0, 4]] {
        let array = NpyArray {
            shape: shape.to_vec(),
            data: NpyData::F32(vec![1.0; if shape.len() == 2 { 6 } else { 0 }]),
        };
        assert!(read(&written(|w| write_npz_arrays(w, &[("depth", &array)]).unwrap())).is_err(), "{shape:?}");
    }
    let mut mixed = known();
    mixed.views[1].confidence = None;
    assert!(write_mini_npz(Cursor::new(Vec::new()), &mixed).unwrap_err().to_string().contains("view 1"));
    let mut sizes = known();
    sizes.views[1].depth = Image::filled(5, 3, 1.0);
    assert!(write_mini_npz(Cursor::new(Vec::new()), &sizes).unwrap_err().to_string().contains("5x3"));
    assert!(write_mini_npz(Cursor::new(Vec::new()), &Prediction::default()).is_err());
}

#[test]
fn a_zip_bomb_is_not_inflated_and_damage_never_panics() {
    let zeros = NpyArray::new(vec![64 << 20], NpyData::U8(vec![0; 64 << 20])).unwrap();
    let bomb = written(|w| write_npz_arrays(w, &[("depth", &zeros)]).unwrap());
    assert!(bomb.len() < 1 << 20, "{}", bomb.len());
    assert!(read(&bomb).unwrap_err().to_string().contains("at most"));
    let many: Vec<(String, NpyArray)> =
        (0..20).map(|i| (format!("a{i}"), NpyArray::new(vec![1], NpyData::U8(vec![0])).unwrap())).collect();
    let many: Vec<(&str, &NpyArray)> = many.iter().map(|(n, a)| (n.as_str(), a)).collect();
    assert!(
        read(&written(|w| write_npz_arrays(w, &many).unwrap()))
            .unwrap_err()
            .to_string()
            .contains("20 entries")
    );
    let good = numpy_file();
    for n in 0..good.len() {
        let _ = read(&good[..n]);
        let mut turned = good.clone();
        turned[n] ^= 0x55;
        let _ = read(&turned);
        turned[n] = 0xff;
        let _ = read(&turned);
    }
}

/// Tensors of a safetensors file.
struct Golden(BTreeMap<String, (Vec<usize>, Vec<u8>)>);

impl Golden {
    /// `None`, with a message, without the folder of shared data.
    fn open() -> Option<Self> {
        let path = vidar_core::testing::shared_data("golden/da3/units_export.safetensors")?;
        let bytes = std::fs::read(path).unwrap();
        let header = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
        let tensors: BTreeMap<String, Value> = serde_json::from_slice(&bytes[8..8 + header]).unwrap();
        let numbers =
            |v: &Value| v.as_array().unwrap().iter().map(|n| n.as_u64().unwrap() as usize).collect();
        let tensor = |(name, entry): (String, Value)| {
            let offsets: Vec<usize> = numbers(&entry["data_offsets"]);
            let data = bytes[8 + header + offsets[0]..8 + header + offsets[1]].to_vec();
            (name, (numbers(&entry["shape"]), data))
        };
        Some(Self(tensors.into_iter().filter(|(n, _)| n != "__metadata__").map(tensor).collect()))
    }

    fn u8(&self, name: &str) -> &[u8] {
        &self.0[name].1
    }

    fn f32(&self, name: &str) -> Vec<f32> {
        self.u8(name).as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect()
    }

    fn f64(&self, name: &str) -> Vec<f64> {
        self.u8(name).as_chunks::<8>().0.iter().map(|b| f64::from_le_bytes(*b)).collect()
    }

    fn prediction(&self) -> Prediction {
        let [n, h, w] = self.0["depth"].0[..] else { panic!() };
        let (depth, conf) = (self.f32("depth"), self.f32("conf"));
        let (e, k) = (self.f32("extrinsics"), self.f32("intrinsics"));
        let pixels = self.u8("processed_images").as_chunks::<3>().0;
        let plane =
            |values: &[f32], v: usize| Image::from_vec(w, h, values[v * h * w..][..h * w].to_vec()).unwrap();
        let view = |v: usize| PredictedView {
            image: Some(Image::from_vec(w, h, pixels[v * h * w..][..h * w].to_vec()).unwrap()),
            depth: plane(&depth, v),
            confidence: Some(plane(&conf, v)),
            extrinsics: Some(std::array::from_fn(|r| std::array::from_fn(|c| e[v * 12 + r * 4 + c]))),
            intrinsics: Some(std::array::from_fn(|r| std::array::from_fn(|c| k[v * 9 + r * 3 + c]))),
        };
        Prediction { views: (0..n).map(view).collect() }
    }
}

fn close(a: &[f64], b: &[f64], tolerance: f64, what: &str) {
    assert_eq!(a.len(), b.len(), "{what}");
    let worst = a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    assert!(worst <= tolerance, "{what}: off by {worst}");
}

#[test]
fn rounding_is_the_official_one_bit_for_bit() {
    let Some(golden) = Golden::open() else { return };
    let prediction = golden.prediction();
    for (bytes, kind) in [
        (written(|w| write_npz(w, &prediction).unwrap()), "npz"),
        (written(|w| write_mini_npz(w, &prediction).unwrap()), "mini_npz"),
    ] {
        let arrays = read_npz(Cursor::new(bytes), NpzLimits::default()).unwrap();
        assert_eq!(arrays["depth"].data, NpyData::F32(golden.f32(&format!("{kind}.depth"))), "{kind}");
        assert_eq!(arrays["conf"].data, NpyData::F32(golden.f32("mini_npz.conf")), "{kind}");
        assert_eq!(arrays["extrinsics"].data, NpyData::F32(golden.f32("extrinsics")), "{kind}");
        assert_eq!(arrays["intrinsics"].data, NpyData::F32(golden.f32("intrinsics")), "{kind}");
        if let Some(image) = arrays.get("image") {
            assert_eq!(image.data, NpyData::U8(golden.u8("processed_images").to_vec()));
        }
    }
}

/// Document and buffer of a GLB.
fn glb_parts(bytes: &[u8]) -> (Value, Vec<u8>) {
    let length = u32::from_le_bytes(bytes[12..16].try_into().unwrap()) as usize;
    assert_eq!(u32::from_le_bytes(bytes[8..12].try_into().unwrap()) as usize, bytes.len());
    (serde_json::from_slice(&bytes[20..20 + length]).unwrap(), bytes[20 + length + 8..].to_vec())
}

fn bytes_of<'a>(document: &Value, buffer: &'a [u8], mesh: usize, attribute: &str) -> &'a [u8] {
    let accessor =
        document["meshes"][mesh]["primitives"][0]["attributes"][attribute].as_u64().unwrap() as usize;
    let view = document["accessors"][accessor]["bufferView"].as_u64().unwrap() as usize;
    let of = |key: &str| document["bufferViews"][view][key].as_u64().unwrap() as usize;
    &buffer[of("byteOffset")..of("byteOffset") + of("byteLength")]
}

fn positions(document: &Value, buffer: &[u8], mesh: usize) -> Vec<f64> {
    let bytes = bytes_of(document, buffer, mesh, "POSITION");
    bytes.as_chunks::<4>().0.iter().map(|b| f64::from(f32::from_le_bytes(*b))).collect()
}

#[test]
fn the_scene_is_the_official_one() {
    let Some(golden) = Golden::open() else { return };
    let mut bytes = Vec::new();
    let summary = write_scene_glb(&mut bytes, &golden.prediction(), &SceneOptions::default()).unwrap();
    close(&[summary.least_confidence], &golden.f64("conf_thr_f64"), 1e-6, "threshold");
    let a: Vec<f64> = summary.scene_from_world.transpose().as_slice().to_vec();
    close(&a, &golden.f64("A_f64"), 1e-6, "A");
    close(&[summary.diagonal], &golden.f64("scene_scale_f64"), 1e-5, "diagonal");
    let (document, buffer) = glb_parts(&bytes);
    close(&positions(&document, &buffer, 0), &golden.f64("points_gltf_f64"), 2e-6, "points");
    let colors: Vec<u8> = bytes_of(&document, &buffer, 0, "COLOR_0")
        .as_chunks::<4>()
        .0
        .iter()
        .flat_map(|&[r, g, b, _]| [r, g, b])
        .collect();
    assert_eq!(colors, golden.u8("colors"));
    // Frusta: segments in the world, in the official order.
    let frusta = golden.f64("frustum_world_f64");
    for camera in 0..2 {
        let expected: Vec<f64> = frusta[camera * 48..][..48]
            .as_chunks::<3>()
            .0
            .iter()
            .flat_map(|p| {
                let p = summary.scene_from_world * nalgebra::Vector4::new(p[0], p[1], p[2], 1.0);
                [p.x, p.y, p.z]
            })
            .collect();
        close(&positions(&document, &buffer, 1 + camera), &expected, 1e-5, "frustum");
        let color = &bytes_of(&document, &buffer, 1 + camera, "COLOR_0")[..3];
        assert_eq!(color, &golden.u8("cam_colors")[camera * 3..][..3], "camera {camera}");
    }
}

#[test]
fn depth_pictures_have_the_official_colours() {
    let Some(golden) = Golden::open() else { return };
    let table = golden.u8("spectral_lut256").as_chunks::<3>().0;
    for (i, color) in table.iter().enumerate() {
        assert_eq!(&spectral((i as f64 + 0.5) / 256.0), color, "step {i}");
    }
    let prediction = golden.prediction();
    let expected = golden.u8("depth_vis_u8").as_chunks::<3>().0;
    let n = prediction.views[0].depth.data().len();
    for (v, view) in prediction.views.iter().enumerate() {
        let colors = depth_colors(&view.depth);
        let differing = colors.data().iter().zip(&expected[v * n..]).filter(|(a, b)| a != b).count();
        // The official program's percentiles are of 32 bits; a value on the edge of a step may fall to the other side.
        assert!(differing <= n / 200, "view {v}: {differing} of {n} differ");
        let mut jpeg = Vec::new();
        write_depth_vis(&mut jpeg, &prediction, v).unwrap();
        let decoded = image::load_from_memory(&jpeg).unwrap().to_rgb8();
        assert_eq!(decoded.dimensions(), (112, 42));
    }
}

#[test]
fn an_official_colmap_model_has_the_expected_content() {
    let folder = tempfile::tempdir().unwrap();
    let original = |name: &str| OriginalImage { name: name.to_owned(), width: 40, height: 60 };
    let originals = [original("a.png"), original("b c.png")];
    let count = write_official_colmap(folder.path(), &known(), &originals, 50.0).unwrap();
    assert_eq!(count, 12);
    let model = vidar_export::read_colmap(folder.path()).unwrap();
    assert_eq!(model.views.len(), 2);
    assert_eq!(model.views[1].image_name, "b c.png");
    let k = model.views[1].intrinsics;
    // 4x3 to 40x60; COLMAP's corner origin is half a pixel from VIDAR's.
    assert_eq!((k.fx, k.fy, k.cx, k.cy, k.width, k.height), (50.0, 120.0, 19.5, 29.5, 40, 60));
    assert!((model.views[1].world_from_camera.translation.x - 0.25).abs() < 1e-12);
    assert_eq!(model.points.len(), 12);
    // The first point is pixel (0, 0) of view 1 at depth 2, confidence 5: u = v = 0.
    let expected = [-2.0 / 5.0 * 2.0 + 0.25, -1.5 / 6.0 * 2.0, 2.0];
    for (a, b) in model.points.positions[0].iter().zip(expected) {
        assert!((f64::from(*a) - b).abs() < 1e-6);
    }
    assert_eq!(model.points.colors[0], [252, 3, 10]);
    for file in ["rigs.bin", "frames.bin"] {
        assert!(std::fs::metadata(folder.path().join(file)).unwrap().len() > 8);
    }
    assert!(write_official_colmap(folder.path(), &known(), &originals[..1], 50.0).is_err());
}

#[test]
fn single_view_networks_have_no_scene_and_report_why() {
    let mut prediction = known();
    prediction.views.iter_mut().for_each(|v| v.intrinsics = None);
    let error = write_scene_glb(&mut Vec::new(), &prediction, &SceneOptions::default()).unwrap_err();
    assert!(error.to_string().contains("no camera"), "{error}");
    let mut without = known();
    without.views.iter_mut().for_each(|v| v.confidence = None);
    let mut bytes = Vec::new();
    let options = SceneOptions { most_points: 5, cameras: false, ..SceneOptions::default() };
    let summary = write_scene_glb(&mut bytes, &without, &options).unwrap();
    assert_eq!((summary.points, summary.written), (24, 5));
    let (document, _) = glb_parts(&bytes);
    assert_eq!(document["meshes"].as_array().unwrap().len(), 1);
}
