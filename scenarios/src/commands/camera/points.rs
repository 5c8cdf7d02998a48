//! `rover camera project | ray | triangulate`: tables of points and pixels.

use super::files::{Loaded, check_one_frame, load_reported};
use crate::{
    commands::CommandError,
    tables::{Table, TableWriter},
};
use nalgebra::{Vector2, Vector3};
use rover_cameras::{Camera, CameraError, Ray, closest_point};
use std::path::PathBuf;

/// Where a table goes.
#[derive(Clone, Debug, clap::Args)]
struct OutArgs {
    /// Writes the table to this file; `-` is standard output
    #[arg(long, value_name = "FILE", default_value = "-")]
    out: PathBuf,
    /// Overwrites outputs that exist
    #[arg(long)]
    force: bool,
}

/// Projects points (x_m,y_m,z_m in the model's frame) to pixels: u_px,v_px,range_m,status
#[derive(Clone, Debug, clap::Args)]
pub(super) struct ProjectArgs {
    /// Camera model
    model: PathBuf,
    /// Points: x_m,y_m,z_m
    points: PathBuf,
    /// Also gives pixels that lie outside the image
    #[arg(long)]
    beyond_image: bool,
    #[command(flatten)]
    out: OutArgs,
}

/// Gives the rays of pixels (u_px,v_px): origin and unit direction in the model's frame
#[derive(Clone, Debug, clap::Args)]
pub(super) struct RayArgs {
    /// Camera model
    model: PathBuf,
    /// Pixels: u_px,v_px
    pixels: PathBuf,
    /// Also answers pixels that lie outside the image
    #[arg(long)]
    beyond_image: bool,
    #[command(flatten)]
    out: OutArgs,
}

/// Triangulates matches (ul_px,vl_px,ur_px,vr_px): x_m,y_m,z_m,miss_m,status
#[derive(Clone, Debug, clap::Args)]
pub(super) struct TriangulateArgs {
    /// Left camera model
    left: PathBuf,
    /// Right camera model, in the same frame
    right: PathBuf,
    /// Matches: ul_px,vl_px,ur_px,vr_px
    matches: PathBuf,
    /// Also answers pixels that lie outside the images
    #[arg(long)]
    beyond_image: bool,
    #[command(flatten)]
    out: OutArgs,
}

/// Answers every row of a table.
fn answer_all<const N: usize, const M: usize>(
    input: &std::path::Path,
    out: &OutArgs,
    columns: (&[&str; N], &[&str; M]),
    answer: impl Fn([f64; N]) -> Result<[f64; M], String>,
) -> Result<(), CommandError> {
    let table = Table::open(input, columns.0)?;
    let mut writer = TableWriter::create(&out.out, out.force, columns.1)?;
    for row in table {
        writer.answer(row?.array().and_then(&answer))?;
        if writer.is_closed() {
            break;
        }
    }
    let (_, refused) = writer.counts();
    writer.finish()?;
    if refused > 0 {
        eprintln!("{refused} rows have no answer; the column status says why");
    }
    Ok(())
}

/// Refuses a pixel outside the image, if the file gives a size and `beyond_image` is not asked for.
fn check_inside(
    loaded: &Loaded,
    pixel_px: &Vector2<f64>,
    beyond_image: bool,
) -> Result<(), CameraError> {
    let Some([width_px, height_px]) = loaded.file.size_px.filter(|_| !beyond_image) else {
        return Ok(());
    };
    let camera = Camera {
        model: loaded.model().clone(),
        width_px,
        height_px,
    };
    if camera.contains(pixel_px, 0.0) {
        return Ok(());
    }
    Err(CameraError::OutsideImage {
        pixel_px: *pixel_px,
        width_px,
        height_px,
        margin_px: 0.0,
    })
}

/// The ray of a pixel of the image.
fn ray_of(loaded: &Loaded, pixel_px: [f64; 2], beyond_image: bool) -> Result<Ray, CameraError> {
    let pixel_px = Vector2::from(pixel_px);
    if !(pixel_px.x + pixel_px.y).is_finite() {
        return Err(CameraError::NotFinite);
    }
    check_inside(loaded, &pixel_px, beyond_image)?;
    loaded.model().ray(&pixel_px)
}

/// `rover camera project`.
pub(super) fn project(args: &ProjectArgs) -> Result<(), CommandError> {
    let loaded = load_reported(&args.model)?;
    let project = |[x, y, z]: [f64; 3]| -> Result<[f64; 3], CameraError> {
        let image = loaded
            .model()
            .project_with_jacobian(&Vector3::new(x, y, z))?;
        check_inside(&loaded, &image.pixel_px, args.beyond_image)?;
        Ok([image.pixel_px.x, image.pixel_px.y, image.range_m])
    };
    answer_all(
        &args.points,
        &args.out,
        (&["x_m", "y_m", "z_m"], &["u_px", "v_px", "range_m"]),
        |point| project(point).map_err(|e| e.to_string()),
    )
}

/// `rover camera ray`.
pub(super) fn ray(args: &RayArgs) -> Result<(), CommandError> {
    let loaded = load_reported(&args.model)?;
    answer_all(
        &args.pixels,
        &args.out,
        (
            &["u_px", "v_px"],
            &["ox_m", "oy_m", "oz_m", "dx", "dy", "dz"],
        ),
        |[u, v]| {
            let ray = ray_of(&loaded, [u, v], args.beyond_image).map_err(|e| e.to_string())?;
            let (o, d) = (ray.origin, ray.direction);
            Ok([o.x, o.y, o.z, d.x, d.y, d.z])
        },
    )
}

/// `rover camera triangulate`.
pub(super) fn triangulate(args: &TriangulateArgs) -> Result<(), CommandError> {
    let (left, right) = (load_reported(&args.left)?, load_reported(&args.right)?);
    check_one_frame(&left, &right)?;
    answer_all(
        &args.matches,
        &args.out,
        (
            &["ul_px", "vl_px", "ur_px", "vr_px"],
            &["x_m", "y_m", "z_m", "miss_m"],
        ),
        |[ul, vl, ur, vr]| {
            let side = |name: &'static str| move |e: CameraError| format!("{name}: {e}");
            let first = ray_of(&left, [ul, vl], args.beyond_image).map_err(side("left"))?;
            let second = ray_of(&right, [ur, vr], args.beyond_image).map_err(side("right"))?;
            let found = closest_point(&first, &second).map_err(|e| e.to_string())?;
            let p = found.point;
            Ok([p.x, p.y, p.z, found.miss_m])
        },
    )
}
