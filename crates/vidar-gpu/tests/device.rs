//! What a device refuses is an error, and what it holds is counted.

#![cfg(feature = "device")]
#![allow(clippy::unwrap_used)]

mod common;

use common::any_device;
use vidar_gpu::ops::{End, product_into};
use vidar_gpu::{AdapterKind, Gpu, GpuError, GpuOptions, Matrix, Recorder, Storage, adapters};

#[test]
fn a_device_that_is_not_there_is_named_with_what_is_there_and_what_to_do() {
    let all = adapters();
    let said = Gpu::open(&GpuOptions { adapter: Some(all.len()), ..GpuOptions::default() });
    let text = said.err().unwrap().to_string();
    assert!(text.contains(&format!("number {}", all.len())) && text.contains("Vulkan"), "{text}");
    let hardware = all.iter().any(|a| a.kind != AdapterKind::Software);
    match Gpu::open(&GpuOptions::default()) {
        Ok(gpu) => assert!(hardware && gpu.adapter().kind != AdapterKind::Software),
        Err(error) => {
            assert!(!hardware, "{error}");
            assert!(error.to_string().contains("compute on the CPU"), "{error}");
        }
    }
}

#[test]
fn bytes_are_counted_and_bounded() {
    let Some(open) = any_device() else { return };
    let index = open.adapter().index;
    drop(open);
    let options = GpuOptions { adapter: Some(index), memory_limit: Some(4096) };
    let gpu = Gpu::open(&options).unwrap();
    let first = gpu.buffer("first", 512).unwrap();
    assert_eq!((gpu.held_bytes(), gpu.peak_bytes()), (2048, 2048));
    let said = gpu.buffer("second", 600).err().unwrap();
    assert!(matches!(said, GpuError::OverBudget { bytes: 2400, held: 2048, allowed: 4096, .. }), "{said}");
    drop(first);
    assert_eq!((gpu.held_bytes(), gpu.peak_bytes()), (0, 2048));
    assert!(gpu.buffer("third", 600).is_ok());
}

#[test]
fn openings_of_a_device_share_it_and_count_their_own_bytes() {
    let Some(first) = any_device() else { return };
    let second = any_device().unwrap();
    let held = first.buffer("first", 512).unwrap();
    assert_eq!((first.held_bytes(), second.held_bytes()), (2048, 0));
    // Only one device's buffers can stand in one product.
    let weight = common::numbers(1, 16 * 16);
    let matrix = Matrix::new(&second, "w", &weight, None, [16, 16], Storage::F32).unwrap();
    held.write(&second, 0, &common::numbers(2, 512));
    let out = second.buffer("y", 32 * 16).unwrap();
    let mut recorder = Recorder::new(&second);
    product_into(&mut recorder, &held, 32, &matrix, &out, End::Gelu).unwrap();
    assert!(recorder.read(&out, 0, 32 * 16).unwrap().iter().any(|value| *value != 0.0));
    drop(held);
    assert_eq!(first.held_bytes(), 0);
}

#[test]
fn a_buffer_larger_than_the_device_binds_is_refused_before_it_is_made() {
    let Some(gpu) = any_device() else { return };
    let said =
        gpu.buffer("everything", usize::try_from(gpu.max_buffer_bytes() / 4).unwrap() + 4).err().unwrap();
    assert!(matches!(said, GpuError::BufferTooLarge { .. }), "{said}");
    assert!(said.to_string().contains("everything"), "{said}");
    assert!(gpu.check().is_ok());
}

#[test]
fn widths_that_the_shaders_do_not_cover_are_named() {
    let Some(gpu) = any_device() else { return };
    let said = Matrix::new(&gpu, "some.layer", &[0.0; 18], None, [3, 6], Storage::F32).err().unwrap();
    assert!(said.to_string().contains("some.layer") && said.to_string().contains("multiple of 4"), "{said}");
}

#[test]
fn the_same_work_gives_the_same_bits() {
    let Some(gpu) = any_device() else { return };
    let weight = common::numbers(1, 80 * 64);
    let matrix = Matrix::new(&gpu, "w", &weight, None, [80, 64], Storage::Bf16).unwrap();
    let x = gpu.upload("x", &common::numbers(2, 50 * 64)).unwrap();
    let run = || {
        let out = gpu.buffer("y", 50 * 80).unwrap();
        let mut recorder = Recorder::new(&gpu);
        product_into(&mut recorder, &x, 50, &matrix, &out, End::Gelu).unwrap();
        recorder.read(&out, 0, 50 * 80).unwrap()
    };
    let bits = |values: Vec<f32>| values.into_iter().map(f32::to_bits).collect::<Vec<_>>();
    assert_eq!(bits(run()), bits(run()));
}
