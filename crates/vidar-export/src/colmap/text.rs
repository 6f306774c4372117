//! COLMAP's text files. Numbers are printed with enough digits to restore the same bits.

use super::{CAMERAS, IMAGES, POINTS, RawCamera, RawImage, TrackEntries, color_of, unsupported_model};
use crate::error::{ExportError, quoted, write_error};
use crate::text::{Line, Lines};
use std::io::{self, Write};
use vidar_core::PointCloud;

pub(super) fn write_cameras(w: &mut dyn Write, cameras: &[RawCamera]) -> Result<(), ExportError> {
    let mut write = || -> io::Result<()> {
        writeln!(w, "# Camera list with one line of data per camera:")?;
        writeln!(w, "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]")?;
        writeln!(w, "# Number of cameras: {}", cameras.len())?;
        for c in cameras {
            let ((fx, fy), (cx, cy)) = (c.focal, c.principal_point);
            writeln!(w, "{} PINHOLE {} {} {fx} {fy} {cx} {cy}", c.id, c.width, c.height)?;
        }
        Ok(())
    };
    write().map_err(write_error(CAMERAS))
}

pub(super) fn write_images(w: &mut dyn Write, images: &[RawImage]) -> Result<(), ExportError> {
    let mut write = || -> io::Result<()> {
        writeln!(w, "# Image list with two lines of data per image:")?;
        writeln!(w, "#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME")?;
        writeln!(w, "#   POINTS2D[] as (X, Y, POINT3D_ID)")?;
        writeln!(w, "# Number of images: {}", images.len())?;
        for image in images {
            let [qw, qx, qy, qz] = image.rotation_wxyz;
            let [tx, ty, tz] = image.translation;
            let (id, camera, name) = (image.id, image.camera_id, &image.name);
            writeln!(w, "{id} {qw} {qx} {qy} {qz} {tx} {ty} {tz} {camera} {name}")?;
            for (i, ([x, y], point)) in image.observations.iter().enumerate() {
                let separator = if i == 0 { "" } else { " " };
                write!(w, "{separator}{x} {y} {point}")?;
            }
            writeln!(w)?;
        }
        Ok(())
    };
    write().map_err(write_error(IMAGES))
}

pub(super) fn write_points(
    w: &mut dyn Write,
    points: &PointCloud,
    tracks: &[TrackEntries],
) -> Result<(), ExportError> {
    let mut write = || -> io::Result<()> {
        writeln!(w, "# 3D point list with one line of data per point:")?;
        writeln!(w, "#   POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)")?;
        writeln!(w, "# Number of points: {}", points.len())?;
        for (i, [x, y, z]) in points.positions.iter().enumerate() {
            let [r, g, b] = color_of(points, i);
            write!(w, "{} {x} {y} {z} {r} {g} {b} -1", i + 1)?;
            for (image, index) in tracks.get(i).into_iter().flatten() {
                write!(w, " {image} {index}")?;
            }
            writeln!(w)?;
        }
        Ok(())
    };
    write().map_err(write_error(POINTS))
}

pub(super) fn read_cameras(bytes: &[u8]) -> Result<Vec<RawCamera>, ExportError> {
    let mut cameras = Vec::new();
    let mut stated = StatedCount::default();
    for line in Lines::new(CAMERAS, bytes)? {
        if stated.is_comment(&line)? {
            continue;
        }
        let tokens: Vec<&str> = line.text.split_ascii_whitespace().collect();
        let [id, model, width, height, params @ ..] = &tokens[..] else {
            return Err(line.error("CAMERA_ID MODEL WIDTH HEIGHT PARAMS", quoted(line.text)));
        };
        let real = |token: &&str| line.finite("a finite camera parameter", token);
        let (focal, principal_point) = match (*model, params) {
            ("PINHOLE", [fx, fy, cx, cy]) => ((real(fx)?, real(fy)?), (real(cx)?, real(cy)?)),
            ("SIMPLE_PINHOLE", [f, cx, cy]) => ((real(f)?, real(f)?), (real(cx)?, real(cy)?)),
            ("PINHOLE" | "SIMPLE_PINHOLE", _) => {
                return Err(line.error("4 (PINHOLE) or 3 (SIMPLE_PINHOLE) parameters", params.len()));
            }
            (other, _) => return Err(unsupported_model(format!("line {}", line.number), &quoted(other))),
        };
        cameras.push(RawCamera {
            id: line.number("a camera id", id)?,
            width: line.number("a width in pixels", width)?,
            height: line.number("a height in pixels", height)?,
            focal,
            principal_point,
        });
    }
    stated.check(CAMERAS, cameras.len())?;
    Ok(cameras)
}

pub(super) fn read_images(bytes: &[u8]) -> Result<Vec<RawImage>, ExportError> {
    let mut images = Vec::new();
    let mut stated = StatedCount::default();
    let mut lines = Lines::new(IMAGES, bytes)?;
    while let Some(line) = lines.next() {
        if stated.is_comment(&line)? {
            continue;
        }
        images.push(read_image(&line)?);
        // The next line is always that image's observations, empty or not.
        if let Some(observations) = lines.next() {
            check_observations(&observations)?;
        }
    }
    stated.check(IMAGES, images.len())?;
    Ok(images)
}

fn read_image(line: &Line<'_>) -> Result<RawImage, ExportError> {
    let tokens: Vec<&str> = line.text.split_ascii_whitespace().collect();
    let [id, qw, qx, qy, qz, tx, ty, tz, camera_id, name] = tokens[..] else {
        let expected = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME";
        return Err(line.error(expected, format_args!("{} columns in {}", tokens.len(), quoted(line.text))));
    };
    let real = |token: &str| line.finite("a finite pose", token);
    Ok(RawImage {
        id: line.number("an image id", id)?,
        rotation_wxyz: [real(qw)?, real(qx)?, real(qy)?, real(qz)?],
        translation: [real(tx)?, real(ty)?, real(tz)?],
        camera_id: line.number("a camera id", camera_id)?,
        name: name.to_owned(),
        observations: Vec::new(),
    })
}

fn check_observations(line: &Line<'_>) -> Result<(), ExportError> {
    let mut count = 0_usize;
    for (i, token) in line.text.split_ascii_whitespace().enumerate() {
        if i % 3 == 2 {
            line.number::<i64>("a point id, or -1", token)?;
        } else {
            line.finite("a pixel coordinate", token)?;
        }
        count += 1;
    }
    if count.is_multiple_of(3) { Ok(()) } else { Err(line.error("triples X Y POINT3D_ID", count)) }
}

pub(super) fn read_points(bytes: &[u8]) -> Result<PointCloud, ExportError> {
    let mut points = PointCloud::default();
    let mut stated = StatedCount::default();
    for line in Lines::new(POINTS, bytes)? {
        if stated.is_comment(&line)? {
            continue;
        }
        let mut tokens = line.text.split_ascii_whitespace();
        let mut next = |what: &str| tokens.next().ok_or_else(|| line.error(what, "the end of the line"));
        line.number::<u64>("a point id", next("a point id")?)?;
        let mut position = [0.0; 3];
        for slot in &mut position {
            *slot = line.finite("a coordinate", next("a coordinate")?)? as f32;
        }
        if !position.iter().all(|v: &f32| v.is_finite()) {
            return Err(line.error("a position within 32-bit floats", quoted(line.text)));
        }
        let mut color = [0; 3];
        for slot in &mut color {
            *slot = line.number("a colour 0 to 255", next("a colour")?)?;
        }
        line.finite("a reprojection error", next("a reprojection error")?)?;
        let mut track = 0_usize;
        for token in tokens {
            line.number::<u32>("a track of IMAGE_ID POINT2D_IDX", token)?;
            track += 1;
        }
        if !track.is_multiple_of(2) {
            return Err(line.error("a track of pairs", format_args!("{track} numbers")));
        }
        points.positions.push(position);
        points.colors.push(color);
    }
    stated.check(POINTS, points.len())?;
    Ok(points)
}

/// The number of records stated in a comment; comparing it with the file detects truncation.
#[derive(Default)]
struct StatedCount(Option<usize>);

impl StatedCount {
    /// Whether the line is blank or a comment; stores a stated count.
    fn is_comment(&mut self, line: &Line<'_>) -> Result<bool, ExportError> {
        let Some(comment) = line.comment() else { return Ok(line.is_blank()) };
        if let Some(rest) = comment.strip_prefix("Number of ")
            && let Some((_, count)) = rest.split_once(": ")
        {
            // COLMAP itself writes "N, mean track length: …" behind the count.
            let digits = count.split(',').next().unwrap_or(count).trim();
            self.0 = Some(line.number("a count", digits)?);
        }
        Ok(true)
    }

    fn check(&self, format: &'static str, found: usize) -> Result<(), ExportError> {
        match self.0 {
            Some(expected) if expected != found => Err(ExportError::malformed(
                format,
                "whole file",
                format!("{expected} records, as stated in its comment"),
                found.to_string(),
            )),
            _ => Ok(()),
        }
    }
}
