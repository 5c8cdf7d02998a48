//! `rover arm plan`: a collision-free motion as a table.

use super::model::{ModelArgs, Source, numbers};
use super::{OutputArgs, joint_columns};
use crate::commands::{CommandError, Exit};
use crate::output::Output;
use crate::tables::{Table, TableWriter};
use nalgebra::{Point3, Unit, Vector3};
use rover_arm_planner::Planner;
use rover_messages::planning::{Plan, PlanGoal, PlanRequest, ToolPose};
use rover_robot::Robot;
use serde::Serialize;
use std::path::PathBuf;

/// The finest and the coarsest table of a motion, s.
const STEPS_S: std::ops::RangeInclusive<f64> = 1e-4..=10.0;

/// A collision-free motion between two configurations: t_s,q1_rad..qN_rad,r1_rad_s..rN_rad_s,status
///
/// The motion keeps the joint, rate and acceleration limits and the distances that the stated quality
/// of the model asks for, to the arm itself, to the body and to the terrain if points of it are given.
/// It needs a robot file: a URDF does not say how good it is, nor how fast joints may accelerate.
#[derive(Clone, Debug, clap::Args)]
#[command(group(clap::ArgGroup::new("goal").required(true).args(["to", "to_tool"])))]
pub struct PlanArgs {
    #[command(flatten)]
    model: ModelArgs,
    /// Where the motion starts: a posture or joint angles, rad
    #[arg(long, value_name = "POSTURE|Q1,..,QN", allow_hyphen_values = true)]
    pub from: String,
    /// Where it ends: a posture or joint angles, rad
    #[arg(long, value_name = "POSTURE|Q1,..,QN", allow_hyphen_values = true)]
    pub to: Option<String>,
    /// Where it ends: tool point, m, and approach axis, arm base frame
    #[arg(long, value_name = "X,Y,Z,AX,AY,AZ", allow_hyphen_values = true)]
    pub to_tool: Option<String>,
    /// The tip moves on a straight line to the tool pose
    #[arg(long, requires = "to_tool")]
    pub straight: bool,
    /// Camera pair that shall see the fiducial at the tool pose
    #[arg(
        long,
        value_name = "PAIR",
        requires = "to_tool",
        conflicts_with = "straight"
    )]
    pub visible_to: Option<String>,
    /// Points of the terrain, rover frame: x_m,y_m,z_m
    #[arg(long, value_name = "POINTS.csv")]
    pub terrain: Option<PathBuf>,
    /// Radius about the tool point within which the instrument may touch the terrain, m
    #[arg(
        long,
        value_name = "RADIUS",
        default_value_t = 0.0,
        requires_all = ["terrain", "to_tool"]
    )]
    pub contact_radius_m: f64,
    /// Fraction of the rate and acceleration limits to use
    #[arg(long, value_name = "FRACTION", default_value_t = 1.0)]
    pub speed_fraction: f64,
    /// Limit of the tip's speed on a straight line, m/s
    #[arg(long, value_name = "SPEED", requires = "straight")]
    pub max_tip_speed_m_s: Option<f64>,
    /// Time between rows of the table, s
    #[arg(long, value_name = "STEP", default_value_t = 0.05)]
    pub step_s: f64,
    /// Writes duration, clearance and end as JSON
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
    #[command(flatten)]
    output: OutputArgs,
}

#[derive(Serialize)]
struct Summary {
    duration_s: f64,
    clearance_m: Option<f64>,
    start_rad: Vec<f64>,
    end_rad: Vec<f64>,
    rows: u64,
}

pub(super) fn run(args: &PlanArgs) -> Result<Exit, CommandError> {
    let bad = |message: String| Err(CommandError::BadInput(message));
    if !STEPS_S.contains(&args.step_s) {
        return bad(format!(
            "--step-s {}: expected {} to {}",
            args.step_s,
            STEPS_S.start(),
            STEPS_S.end()
        ));
    }
    let json = args
        .json
        .as_ref()
        .map(|path| Output::open(path, args.output.force))
        .transpose()?;
    if json == Some(Output::Stdout) && args.output.out.as_os_str() == "-" {
        return bad("--json - and --out -: only one of them can be standard output".into());
    }
    let model = args.model.load()?;
    let Source::Robot(robot) = &model.source else {
        return bad(
            "a plan needs a robot file: a URDF has no acceleration limits and no stated quality"
                .into(),
        );
    };
    let start = model.joints("--from", &args.from)?;
    let request = PlanRequest {
        start_rad: Some(start.clone()),
        goal: match (&args.to, &args.to_tool) {
            (Some(text), _) => PlanGoal::Joints(model.joints("--to", text)?),
            (None, Some(text)) => {
                let pose = tool_pose(robot, text)?;
                if args.straight {
                    PlanGoal::Straight(vec![pose])
                } else {
                    let visible_to = args.visible_to.clone();
                    PlanGoal::Tool { pose, visible_to }
                }
            }
            (None, None) => return bad("--to or --to-tool is needed".into()),
        },
        speed_fraction: args.speed_fraction,
        max_tip_speed_m_s: args.max_tip_speed_m_s,
        contact_radius_m: args.contact_radius_m,
    };
    rover_messages::Wire::validate(&request).map_err(CommandError::BadInput)?;
    let mut planner = Planner::new(robot.clone());
    if let Some(path) = &args.terrain {
        let mut points = Vec::new();
        for row in Table::open(path, &["x_m", "y_m", "z_m"])? {
            // A point that an earlier command could not measure is not one.
            if let Ok(xyz) = row?.array::<3>() {
                points.push(Vector3::from(xyz));
            }
        }
        let map = planner.map_of(&points, &start).map_err(refused)?;
        planner = planner.with_terrain(map);
    }
    let plan = planner.plan(&request, &start).map_err(refused)?;
    write(args, &plan, start, json)
}

fn refused(fault: rover_messages::Fault) -> CommandError {
    CommandError::BadInput(fault.to_string())
}

fn tool_pose(robot: &Robot, text: &str) -> Result<ToolPose, CommandError> {
    let cells = numbers("--to-tool", text)?;
    let wrong = |what: &str| CommandError::BadInput(format!("--to-tool {text}: {what}"));
    let [x, y, z, ax, ay, az] = cells[..] else {
        return Err(wrong("expected x,y,z,ax,ay,az"));
    };
    let axis = Unit::try_new(Vector3::new(ax, ay, az), 1e-9)
        .ok_or_else(|| wrong("the axis ax,ay,az is zero"))?;
    let rover_from_base = robot.rover_from_arm_base.isometry;
    Ok(ToolPose {
        tip_m: (rover_from_base * Point3::new(x, y, z)).coords.into(),
        axis: (rover_from_base.rotation * axis).into(),
    })
}

fn write(
    args: &PlanArgs,
    plan: &Plan,
    start_rad: Vec<f64>,
    json: Option<Output>,
) -> Result<Exit, CommandError> {
    let n = plan.end_rad.len();
    let columns: Vec<String> = std::iter::once("t_s".to_owned())
        .chain(joint_columns(n))
        .chain((1..=n).map(|i| format!("r{i}_rad_s")))
        .collect();
    let mut out = TableWriter::create(&args.output.out, args.output.force, &columns)?;
    let duration_s = plan.trajectory.duration_s();
    let mut index = 0.0;
    loop {
        // The last row is the end itself.
        let t_s = f64::min(index * args.step_s, duration_s);
        let (q, rates) = plan.trajectory.sample(t_s);
        let row: Vec<f64> = std::iter::once(t_s).chain(q).chain(rates).collect();
        out.answer::<_, String>(Ok(row))?;
        if t_s >= duration_s || out.is_closed() {
            break;
        }
        index += 1.0;
    }
    let (rows, _) = out.counts();
    out.finish()?;
    if let Some(output) = json {
        let summary = Summary {
            duration_s,
            clearance_m: plan.clearance_m,
            start_rad,
            end_rad: plan.end_rad.clone(),
            rows,
        };
        let text = serde_json::to_string_pretty(&summary).map_err(anyhow::Error::from)?;
        output.write(&format!("{text}\n"))?;
    }
    Ok(Exit::Done)
}
