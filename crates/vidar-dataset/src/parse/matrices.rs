//! Matrices as text: intrinsics, 4×4 poses in one file or one line each.

use crate::error::DatasetError;
use crate::source::{Row, Source};
use nalgebra::Matrix4;
use vidar_core::{Se3, Warning};

/// All numbers of a file, at most `limit`.
fn all_numbers(source: &Source<'_>, limit: usize) -> Result<Vec<(usize, f64)>, DatasetError> {
    let mut out = Vec::new();
    for row in source.lines(&mut Vec::new())?.rows {
        for field in row.fields() {
            if out.len() == limit {
                return Err(source.malformed(row.line, format!("more than {limit} numbers"), "one matrix"));
            }
            out.push((row.line, source.number(&row, field, "a matrix")?));
        }
    }
    Ok(out)
}

/// Reads `[fx, fy, cx, cy]` from a 3×3 (or 4×4, or 3×4) matrix or from four numbers in that order.
///
/// The matrix must be upper triangular without skew and end in 1, else it is not a pinhole camera.
pub fn intrinsics_matrix(source: &Source<'_>) -> Result<[f64; 4], DatasetError> {
    let numbers: Vec<f64> = all_numbers(source, 16)?.into_iter().map(|(_, v)| v).collect();
    let at = |row: usize, column: usize, columns: usize| numbers[row * columns + column];
    let columns = match numbers.len() {
        4 => return Ok([numbers[0], numbers[1], numbers[2], numbers[3]]),
        9 => 3,
        12 | 16 => 4,
        n => {
            let expected = "9 numbers (a 3x3 matrix) or 4 (fx fy cx cy)";
            return Err(source.malformed(0, format!("{n} numbers"), expected));
        }
    };
    let zeros = [at(0, 1, columns), at(1, 0, columns), at(2, 0, columns), at(2, 1, columns)];
    // Skew below a hundredth of a pixel is rounding.
    if zeros.iter().any(|z| !(z.abs() < 0.01)) || !((at(2, 2, columns) - 1.0).abs() < 1e-6) {
        let expected = "rows (fx 0 cx) (0 fy cy) (0 0 1)";
        return Err(source.malformed(0, "a matrix that is not a pinhole camera", expected));
    }
    Ok([at(0, 0, columns), at(1, 1, columns), at(0, 2, columns), at(1, 2, columns)])
}

/// A row of 12 or 16 numbers as a 4×4 matrix.
pub(super) fn row_matrix(source: &Source<'_>, row: &Row<'_>) -> Result<Matrix4<f64>, DatasetError> {
    let mut m = Matrix4::identity();
    let mut count = 0;
    for field in row.fields() {
        if count < 16 {
            m[(count / 4, count % 4)] = source.number(row, field, "a pose matrix")?;
        }
        count += 1;
    }
    check_last_row(source, row.line, &m, count)?;
    Ok(m)
}

fn check_last_row(
    source: &Source<'_>,
    line: usize,
    m: &Matrix4<f64>,
    count: usize,
) -> Result<(), DatasetError> {
    let last = [m[(3, 0)], m[(3, 1)], m[(3, 2)], m[(3, 3)] - 1.0];
    if count != 12 && count != 16 {
        return Err(source.malformed(
            line,
            format!("{count} numbers"),
            "12 or 16 numbers of a row-major matrix",
        ));
    }
    // NaN passes: the whole pose is then skipped (tracking lost).
    if last.iter().any(|v| v.abs() > 1e-6) {
        return Err(source.malformed(line, "a last row that is not 0 0 0 1", "a row-major rigid motion"));
    }
    Ok(())
}

/// Reads one row-major 4×4 (or 3×4) pose per line; `None` where the row is not finite.
pub fn matrix_poses(source: &Source<'_>) -> Result<(Vec<Option<Se3>>, Vec<Warning>), DatasetError> {
    let mut notes = Vec::new();
    let mut out = Vec::new();
    for row in source.lines(&mut notes)?.rows {
        let m = row_matrix(source, &row)?;
        out.push(if m.iter().all(|v| v.is_finite()) { Some(rigid(source, row.line, &m)?) } else { None });
    }
    Ok((out, notes))
}

/// Reads the one 4×4 pose of a 7-Scenes `.pose.txt`; `None` where it is not finite.
pub fn single_pose(source: &Source<'_>) -> Result<Option<Se3>, DatasetError> {
    let numbers = all_numbers(source, 16)?;
    if numbers.len() != 16 {
        return Err(source.malformed(0, format!("{} numbers", numbers.len()), "16 numbers of a 4x4 matrix"));
    }
    if numbers.iter().any(|(_, v)| !v.is_finite()) {
        return Ok(None);
    }
    let m = Matrix4::from_row_iterator(numbers.iter().map(|(_, v)| *v));
    check_last_row(source, numbers[15].0, &m, 16)?;
    rigid(source, 1, &m).map(Some)
}

/// The rigid motion of a matrix in a file of poses.
pub(super) fn rigid(source: &Source<'_>, line: usize, m: &Matrix4<f64>) -> Result<Se3, DatasetError> {
    Se3::from_matrix(m).ok_or_else(|| {
        source.malformed(line, crate::calibration::departure(m), "a rigid motion (orthonormal rotation)")
    })
}
