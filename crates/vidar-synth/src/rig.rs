//! The simulated rig: EuRoC's cam0 and IMU (Burri et al., "The EuRoC micro aerial vehicle datasets", IJRR 2016).

use crate::config::SynthConfig;
use crate::error::SynthError;
use nalgebra::Matrix4;
use vidar_core::camera::RadTan;
use vidar_core::{CameraModel, Duration, ImuNoise, Pinhole, Rig, RigCamera, Se3};

/// EuRoC's image size.
const EUROC_SIZE: [usize; 2] = [752, 480];

/// cam0: fx, fy, cx, cy.
const EUROC_INTRINSICS: [f64; 4] = [458.654, 457.296, 367.215, 248.375];

/// cam0: k1, k2, p1, p2.
const EUROC_DISTORTION: [f64; 4] = [-0.283_408_11, 0.073_959_07, 0.000_193_59, 1.761_871_14e-5];

/// Place of cam0 on the body.
#[rustfmt::skip]
pub(crate) const EUROC_BODY_FROM_CAMERA: [f64; 16] = [
    0.014_865_542_981_8, -0.999_880_929_698, 0.004_140_296_794_22, -0.021_640_145_497_5,
    0.999_557_249_008, 0.014_967_213_324_7, 0.025_715_529_948, -0.064_676_986_768,
    -0.025_774_436_697_4, 0.003_756_188_357_97, 0.999_660_727_178, 0.009_810_730_589_49,
    0.0, 0.0, 0.0, 1.0,
];

/// EuRoC's cam0 scaled to `width` × `height`: the whole width or height is kept, the other cut about the middle.
pub fn euroc_camera(width: usize, height: usize) -> Result<CameraModel, SynthError> {
    let [w0, h0] = EUROC_SIZE.map(|v| v as f64);
    let [fx, fy, cx, cy] = EUROC_INTRINSICS;
    let s = (width as f64 / w0).max(height as f64 / h0);
    let middle = |c: f64, full: f64, kept: usize| (c + 0.5) * s - 0.5 - 0.5 * (full * s - kept as f64);
    let pinhole = Pinhole::new(fx * s, fy * s, middle(cx, w0, width), middle(cy, h0, height), width, height)?;
    Ok(CameraModel::RadTan(RadTan::new(pinhole, EUROC_DISTORTION)?))
}

/// Where cam0 sits on EuRoC's body.
pub fn euroc_body_from_camera() -> Se3 {
    Se3::from_matrix(&Matrix4::from_row_slice(&EUROC_BODY_FROM_CAMERA)).unwrap_or(Se3::IDENTITY)
}

/// Where cam0 sits on the TUM-VI rig's IMU (Schubert et al., "The TUM VI benchmark", IROS 2018), about.
pub(crate) fn tum_vi_body_from_camera() -> Se3 {
    #[rustfmt::skip]
    let matrix = Matrix4::new(
        -0.999_525_037_869_674_3, 0.029_615_343_885_863_2, -0.008_522_328_211_654_74, 0.047_279_882_249_143_92,
        0.007_501_918_507_405_204, -0.034_397_360_613_931_44, -0.999_380_079_249_888_3, -0.047_443_232_143_367_08,
        -0.029_890_130_316_433_09, -0.998_969_345_370_175, 0.034_158_851_273_856_16, -0.068_199_960_506_629_7,
        0.0, 0.0, 0.0, 1.0,
    );
    Se3::from_matrix(&matrix).unwrap_or(Se3::IDENTITY)
}

/// EuRoC's rig with one camera of `width` × `height`.
pub fn euroc_rig(width: usize, height: usize) -> Result<Rig, SynthError> {
    let camera = RigCamera {
        model: euroc_camera(width, height)?,
        body_from_camera: euroc_body_from_camera(),
        time_offset: Duration::ZERO,
        rate_hz: None,
    };
    Ok(Rig { cameras: vec![camera], imu: Some(ImuNoise::EUROC) })
}

/// The rig that `config` simulates: one camera with its true calibration.
pub(crate) fn rig(config: &SynthConfig) -> Result<Rig, SynthError> {
    let camera = RigCamera {
        model: config.camera()?,
        body_from_camera: config.body_from_camera(),
        time_offset: Duration::ZERO,
        rate_hz: None,
    };
    Ok(Rig { cameras: vec![camera], imu: Some(config.imu_noise) })
}
