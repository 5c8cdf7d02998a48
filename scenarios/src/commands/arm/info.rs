//! `rover arm info`: what an arm is made of.

use super::model::{ArmModel, ModelArgs, Source};
use crate::commands::{CommandError, Exit};
use crate::output::{Output, print};
use nalgebra::{Isometry3, Vector3};
use rover_kinematics::NO_RATE_LIMIT_RAD_S;
use rover_kinematics::{AxisGoal, IkError, solve_axis};
use serde::Serialize;
use std::fmt::Write;
use std::path::PathBuf;

/// What the arm is made of: rows, limits, reach, tool, whether it has a closed-form inverse
#[derive(Clone, Debug, clap::Args)]
pub struct InfoArgs {
    #[command(flatten)]
    model: ModelArgs,
    /// Writes the same as JSON; `-` is standard output, in place of the text
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
    /// Overwrites an output that exists
    #[arg(long)]
    pub force: bool,
}

#[derive(Serialize)]
struct Pose {
    position_m: [f64; 3],
    quaternion_wxyz: [f64; 4],
}

#[derive(Serialize)]
struct Joint {
    name: String,
    theta_offset_rad: f64,
    d_m: f64,
    a_m: f64,
    alpha_rad: f64,
    tilt_rad: f64,
    lower_rad: f64,
    upper_rad: f64,
    /// A URDF need not have one.
    max_rate_rad_s: Option<f64>,
    /// A URDF has none.
    max_acceleration_rad_s2: Option<f64>,
    /// Only a URDF has it.
    effort_nm: Option<f64>,
}

#[derive(Serialize)]
struct Posture {
    name: String,
    joints_rad: Vec<f64>,
    tool: Pose,
}

#[derive(Serialize)]
struct Mesh {
    link: String,
    line: u32,
    uri: String,
    path: Option<PathBuf>,
}

#[derive(Serialize)]
struct FreeJoints {
    point_and_axis: usize,
    pose: usize,
}

#[derive(Serialize)]
struct Info {
    name: String,
    /// The frame that poses are given in.
    frame: String,
    joints: Vec<Joint>,
    frame_from_rows: Pose,
    last_from_tool: Pose,
    tool_axis_in_last: [f64; 3],
    reach_m: f64,
    inverse: String,
    /// Joints beyond the five that a tool point with its axis fixes, and beyond the six of a pose:
    /// with any, the answers are a continuum and `arm ik --all` gives samples of it.
    free_joints_n: FreeJoints,
    postures: Vec<Posture>,
    meshes: Vec<Mesh>,
    notes: Vec<String>,
}

fn pose(p: &Isometry3<f64>) -> Pose {
    let (t, r) = (p.translation.vector, p.rotation);
    Pose {
        position_m: t.into(),
        quaternion_wxyz: [r.w, r.i, r.j, r.k],
    }
}

pub(super) fn run(args: &InfoArgs) -> Result<Exit, CommandError> {
    let json = args
        .json
        .as_ref()
        .map(|path| Output::open(path, args.force))
        .transpose()?;
    let model = args.model.load()?;
    let info = collect(&model)?;
    for note in &info.notes {
        eprintln!("rover: {note}");
    }
    if json != Some(Output::Stdout) {
        print(&text(&info))?;
    }
    if let Some(output) = json {
        let text = serde_json::to_string_pretty(&info).map_err(anyhow::Error::from)?;
        output.write(&format!("{text}\n"))?;
    }
    Ok(Exit::Done)
}

fn collect(model: &ArmModel) -> Result<Info, CommandError> {
    let arm = &model.arm;
    let internal = |e| CommandError::Internal(anyhow::Error::from(e));
    let mut postures = Vec::new();
    let (mut notes, mut meshes) = (Vec::new(), Vec::new());
    let (name, frame, names, efforts);
    match &model.source {
        Source::Robot(robot) => {
            name = robot.name().to_owned();
            frame = "arm base".to_owned();
            let joints = &robot.description().arm.joints;
            names = joints.iter().map(|j| j.name.clone()).collect::<Vec<_>>();
            efforts = vec![None; names.len()];
            for (name, q) in &robot.description().postures {
                postures.push(Posture {
                    name: name.clone(),
                    joints_rad: q.clone(),
                    tool: pose(&model.forward(q).map_err(internal)?),
                });
            }
        }
        Source::Urdf(both) => {
            let (urdf, chain) = both.as_ref();
            name = urdf.name.clone();
            frame = format!("link {}, tool at link {}", chain.base_link, chain.tip_link);
            names = chain.joint_names.clone();
            efforts = chain.efforts_nm.clone();
            let said = urdf.notes.iter().chain(&chain.notes);
            notes.extend(said.map(|n| format!("{}:{}: {}", urdf.file, n.line, n.message)));
            for mesh in &urdf.meshes {
                if mesh.path.is_none() {
                    notes.push(format!(
                        "{}:{}: no file for the mesh `{}`; --package-path names where packages are",
                        urdf.file, mesh.line, mesh.uri
                    ));
                }
                meshes.push(Mesh {
                    link: mesh.link.clone(),
                    line: mesh.line,
                    uri: mesh.uri.clone(),
                    path: mesh.path.clone(),
                });
            }
        }
    }
    let joints = names.into_iter().zip(efforts).enumerate();
    let joints = joints.map(|(i, (name, effort_nm))| {
        let (row, l) = (&arm.rows()[i], &arm.limits()[i]);
        Joint {
            name,
            theta_offset_rad: row.theta_offset_rad,
            d_m: row.d_m,
            a_m: row.a_m,
            alpha_rad: row.alpha_rad,
            tilt_rad: arm.tilts_rad().get(i).copied().unwrap_or(0.0),
            lower_rad: l.lower_rad,
            upper_rad: l.upper_rad,
            max_rate_rad_s: Some(l.max_rate_rad_s).filter(|r| *r < NO_RATE_LIMIT_RAD_S),
            max_acceleration_rad_s2: Some(l.max_acceleration_rad_s2).filter(|a| *a < f64::MAX),
            effort_nm,
        }
    });
    let joints = joints.collect();
    let middle = AxisGoal::at(arm, &model.tool, &model.middle()).map_err(internal)?;
    let inverse = match solve_axis(arm, &model.tool, &middle) {
        Err(IkError::NotThisFamily(why)) => format!("numeric: {why} for the closed form"),
        _ => "closed form".into(),
    };
    Ok(Info {
        name,
        frame,
        joints,
        frame_from_rows: pose(&model.base_from_arm_base),
        last_from_tool: pose(&model.last_from_tool),
        tool_axis_in_last: Vector3::from(model.tool.axis_in_link.into_inner()).into(),
        reach_m: arm.reach_m(model.tool.tip_in_link.norm()),
        inverse,
        free_joints_n: FreeJoints {
            point_and_axis: model.free_joints(5),
            pose: model.free_joints(6),
        },
        postures,
        meshes,
        notes,
    })
}

fn text(info: &Info) -> String {
    let mut text = String::new();
    // Writing to a string does not fail.
    let mut line = |t: String| {
        let _ = writeln!(text, "{}", t.trim_end());
    };
    line(format!(
        "{}: {} joints, poses in frame: {}",
        info.name,
        info.joints.len(),
        info.frame
    ));
    line(format!("inverse kinematics: {}", info.inverse));
    if info.free_joints_n.point_and_axis > 0 {
        let six = if info.free_joints_n.pose > 0 {
            ", and of a pose,"
        } else {
            ""
        };
        line(format!(
            "answers of a tool point with its axis{six} are a continuum: `arm ik --all` gives samples"
        ));
    }
    line(format!("reach: at most {:.4} m", info.reach_m));
    let [x, y, z] = info.last_from_tool.position_m;
    let [ax, ay, az] = info.tool_axis_in_last;
    line(format!(
        "tool on the last link: tip {x:.6} {y:.6} {z:.6} m, axis {ax:.6} {ay:.6} {az:.6}"
    ));
    line(String::new());
    let width = info
        .joints
        .iter()
        .map(|j| j.name.chars().count())
        .max()
        .unwrap_or(5)
        .max(5);
    line(format!(
        "{:width$} {:>10} {:>10} {:>10} {:>10} {:>10} {:>8} {:>8} {:>8}",
        "joint", "offset_rad", "d_m", "a_m", "alpha_rad", "tilt_rad", "lower", "upper", "rad/s"
    ));
    for j in &info.joints {
        line(format!(
            "{:width$} {:>10.6} {:>10.6} {:>10.6} {:>10.6} {:>10.3e} {:>8.4} {:>8.4} {:>8}",
            j.name,
            j.theta_offset_rad,
            j.d_m,
            j.a_m,
            j.alpha_rad,
            j.tilt_rad,
            j.lower_rad,
            j.upper_rad,
            j.max_rate_rad_s
                .map_or("none".into(), |r| format!("{r:.4}"))
        ));
    }
    if !info.postures.is_empty() {
        line(String::new());
    }
    for p in &info.postures {
        let [x, y, z] = p.tool.position_m;
        line(format!("posture {}: tip at {x:.6} {y:.6} {z:.6} m", p.name));
    }
    for mesh in &info.meshes {
        let found = match &mesh.path {
            Some(path) => path.display().to_string(),
            None => "not found".into(),
        };
        line(format!("mesh of {}: {} -> {found}", mesh.link, mesh.uri));
    }
    text
}
