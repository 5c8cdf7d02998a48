//! `rover arm`: kinematics and motions of one's own arm, on tables.

mod info;
mod model;
mod plan;

pub use info::InfoArgs;
pub use model::{ArmModel, ModelArgs};
pub use plan::PlanArgs;

use super::{CommandError, Exit};
use crate::tables::{Table, TableWriter};
use nalgebra::{Isometry3, Quaternion, Unit, UnitQuaternion, Vector3};
use rover_kinematics::{
    AxisGoal, PoseGoal, all_poses, all_solutions, closest_pose, closest_solution,
};
use std::path::PathBuf;

/// Kinematics and motions of an arm: one's own robot file or URDF, or a shipped robot
#[derive(Clone, Debug, clap::Args)]
pub struct ArmArgs {
    #[command(subcommand)]
    verb: Verb,
}

#[derive(Clone, Debug, clap::Subcommand)]
enum Verb {
    Info(InfoArgs),
    Fk(FkArgs),
    Ik(IkArgs),
    Plan(PlanArgs),
}

/// Where a table comes from and goes to.
#[derive(Clone, Debug, clap::Args)]
pub struct OutputArgs {
    /// Where the table goes; `-` is standard output
    #[arg(long, value_name = "FILE", default_value = "-")]
    pub out: PathBuf,
    /// Overwrites an output that exists
    #[arg(long)]
    pub force: bool,
}

/// Joint angles to tool poses: q1_rad..qN_rad -> x_m,y_m,z_m,qw,qx,qy,qz,status
///
/// The pose is that of the tool frame in the arm's base frame (of a URDF: of the tip link in the base
/// link). For a robot file the tool frame has its origin at the tip and its z along the approach axis.
/// Joint limits are not looked at.
#[derive(Clone, Debug, clap::Args)]
pub struct FkArgs {
    #[command(flatten)]
    model: ModelArgs,
    /// Table of joint angles; `-` is standard input
    #[arg(value_name = "JOINTS.csv")]
    pub joints: PathBuf,
    #[command(flatten)]
    output: OutputArgs,
}

/// Tool poses to joint angles: x_m,y_m,z_m,ax,ay,az -> q1_rad..qN_rad,status
///
/// A target is the tool point and the approach axis in the arm's base frame; with --pose it is a whole
/// pose, for arms of six or seven joints: x_m,y_m,z_m,qw,qx,qy,qz. Answers are within the joint limits.
/// A target without an answer says which condition fails, and by how much. Where the arm has more joints
/// than the target fixes (five by point and axis, six by a pose) there is a continuum of answers, of
/// which --all gives samples.
#[derive(Clone, Debug, clap::Args)]
pub struct IkArgs {
    #[command(flatten)]
    model: ModelArgs,
    /// Table of targets; `-` is standard input
    #[arg(value_name = "TARGETS.csv")]
    pub targets: PathBuf,
    /// All branches (samples of them where they are a continuum), one row each, with the number of
    /// the target in a first column `row`
    #[arg(long)]
    pub all: bool,
    /// Targets are whole poses
    #[arg(long)]
    pub pose: bool,
    /// Of several answers the one nearest to this: a posture or joint angles, rad; the middle of the
    /// limits if not given
    #[arg(
        long,
        value_name = "POSTURE|Q1,..,QN",
        conflicts_with = "all",
        allow_hyphen_values = true
    )]
    pub near: Option<String>,
    #[command(flatten)]
    output: OutputArgs,
}

/// Runs `rover arm`.
///
/// # Errors
/// [`CommandError`].
pub fn run(args: ArmArgs) -> Result<Exit, CommandError> {
    match args.verb {
        Verb::Info(args) => info::run(&args),
        Verb::Fk(args) => fk(&args),
        Verb::Ik(args) => ik(&args),
        Verb::Plan(args) => plan::run(&args),
    }
}

/// `q1_rad..qN_rad`.
fn joint_columns(n: usize) -> Vec<String> {
    (1..=n).map(|i| format!("q{i}_rad")).collect()
}

const POSE: [&str; 7] = ["x_m", "y_m", "z_m", "qw", "qx", "qy", "qz"];
const POINT_AXIS: [&str; 6] = ["x_m", "y_m", "z_m", "ax", "ay", "az"];

fn fk(args: &FkArgs) -> Result<Exit, CommandError> {
    args.model.check_used("arm fk", &[])?;
    let model = args.model.load()?;
    let table = Table::open(&args.joints, &joint_columns(model.arm.joint_count()))?;
    let mut out = TableWriter::create(&args.output.out, args.output.force, &POSE)?;
    for row in table {
        let row = row?;
        out.answer(row.values().and_then(|q| {
            let pose = model.forward(q).map_err(|e| e.to_string())?;
            let (p, r) = (pose.translation.vector, pose.rotation);
            // Of the two quaternions the one with a positive scalar part.
            let sign = if r.w < 0.0 { -1.0 } else { 1.0 };
            Ok([
                p.x,
                p.y,
                p.z,
                sign * r.w,
                sign * r.i,
                sign * r.j,
                sign * r.k,
            ])
        }))?;
        if out.is_closed() {
            break;
        }
    }
    finish(out)
}

fn ik(args: &IkArgs) -> Result<Exit, CommandError> {
    match (args.all, args.pose) {
        (true, true) => args.model.check_used("arm ik --all --pose", &[]),
        (true, false) => args.model.check_used("arm ik --all", &["--tool-axis"]),
        (false, true) => args
            .model
            .check_used("arm ik --pose", &["--max-rate-rad-s"]),
        (false, false) => args
            .model
            .check_used("arm ik", &["--tool-axis", "--max-rate-rad-s"]),
    }?;
    let model = args.model.load()?;
    let free = model.free_joints(if args.pose { 6 } else { 5 });
    if args.all && free > 0 {
        eprintln!(
            "rover: an arm of {} joints reaches {} in a continuum of postures: the rows are samples \
             of it, not all of them",
            model.arm.joint_count(),
            if args.pose {
                "a pose"
            } else {
                "a point with an axis"
            }
        );
    }
    let near = match &args.near {
        None => model.middle(),
        Some(text) => model.joints("--near", text)?,
    };
    let columns: &[&str] = if args.pose { &POSE } else { &POINT_AXIS };
    let table = Table::open(&args.targets, columns)?;
    let mut header = joint_columns(model.arm.joint_count());
    if args.all {
        header.insert(0, "row".into());
    }
    let mut out = TableWriter::create(&args.output.out, args.output.force, &header)?;
    for (row, number) in table.zip(1_u32..) {
        let row = row?;
        let answers = row.values().and_then(|cells| {
            if args.pose {
                let goal = pose_goal(&model, cells)?;
                if args.all {
                    all_poses(&model.arm, &goal)
                } else {
                    closest_pose(&model.arm, &goal, &near).map(|q| vec![q])
                }
            } else {
                let goal = axis_goal(&model, cells)?;
                if args.all {
                    all_solutions(&model.arm, &model.tool, &goal)
                } else {
                    closest_solution(&model.arm, &model.tool, &goal, &near).map(|q| vec![q])
                }
            }
            .map_err(|e| e.to_string())
        });
        if args.all {
            let number = f64::from(number);
            match answers {
                Err(reason) => out.refuse_after(&[number], &reason)?,
                Ok(answers) => {
                    for mut q in answers {
                        q.insert(0, number);
                        out.answer::<_, String>(Ok(q))?;
                    }
                }
            }
        } else {
            out.answer(answers.and_then(|mut all| all.pop().ok_or("no answer".to_owned())))?;
        }
        if out.is_closed() {
            break;
        }
    }
    finish(out)
}

fn finish(out: TableWriter) -> Result<Exit, CommandError> {
    let (answered, refused) = out.counts();
    out.finish()?;
    if refused > 0 {
        eprintln!(
            "rover: {refused} of {} rows have no answer; the column `status` says why",
            answered + refused
        );
    }
    Ok(Exit::Done)
}

fn point(cells: &[f64]) -> Result<Vector3<f64>, String> {
    match cells {
        [x, y, z, ..] => Ok(Vector3::new(*x, *y, *z)),
        _ => Err(format!("{} numbers, expected a point", cells.len())),
    }
}

/// A goal from tool point and approach axis in the arm's base frame, brought to the rows' own frame.
fn axis_goal(model: &ArmModel, cells: &[f64]) -> Result<AxisGoal, String> {
    let axis = point(cells.get(3..).unwrap_or_default())?;
    let axis = Unit::try_new(axis, 1e-9)
        .ok_or_else(|| "the axis ax,ay,az is zero, expected a direction".to_owned())?;
    let rows_from_base = model.base_from_arm_base.inverse();
    Ok(AxisGoal {
        point: (rows_from_base * nalgebra::Point3::from(point(cells)?)).coords,
        axis: rows_from_base.rotation * axis,
    })
}

/// A goal from a tool pose in the arm's base frame.
fn pose_goal(model: &ArmModel, cells: &[f64]) -> Result<PoseGoal, String> {
    let &[_, _, _, w, i, j, k] = cells else {
        return Err(format!("{} numbers, expected a pose", cells.len()));
    };
    let quaternion = Quaternion::new(w, i, j, k);
    let norm = quaternion.norm();
    if (norm - 1.0).abs() > 1e-3 {
        return Err(format!("the quaternion has the norm {norm:.6}, expected 1"));
    }
    let pose = Isometry3::from_parts(
        point(cells)?.into(),
        UnitQuaternion::from_quaternion(quaternion),
    );
    Ok(PoseGoal {
        link_from_tool: model.last_from_tool,
        base_from_tool: model.base_from_arm_base.inverse() * pose,
    })
}
