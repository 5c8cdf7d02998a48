//! The chain between two links as an arm.

use super::convert::{Line, rows};
use super::{JointKind, Note, Urdf, UrdfError, UrdfJoint};
use nalgebra::{Isometry3, Unit, Vector3};
use rover_kinematics::{
    Arm, ArmError, JointLimits, MAX_JOINTS, MIN_JOINTS, NO_RATE_LIMIT_RAD_S, Tool,
};
use std::f64::consts::TAU;

/// How far a joint without limits may turn to either side, rad.
const ENDLESS_RAD: f64 = TAU;

/// Which chain, and what the file may lack.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ChainOptions {
    /// Link that the arm stands on; the model's only root if not given.
    pub base: Option<String>,
    /// Link that carries the tool; if not given the only end of an arm of 4 to 7 joints, refused
    /// where this arm has other ends.
    pub tip: Option<String>,
    /// Rate limit of joints that have none in the file, rad/s; [`NO_RATE_LIMIT_RAD_S`] if not given.
    pub max_rate_rad_s: Option<f64>,
    /// Acceleration limit of all joints, rad/s^2: the format has none.
    pub max_acceleration_rad_s2: Option<f64>,
}

/// An arm taken from a URDF.
///
/// The rows of [`arm`](Self::arm) start in a frame of their own, whose z axis is the first joint's:
/// poses in the base link's frame are `base_from_arm_base * arm.forward(q) * last_from_tip`.
#[derive(Clone, Debug, PartialEq)]
pub struct UrdfArm {
    /// The arm; its joint angles are those of the URDF.
    pub arm: Arm,
    /// Link that it stands on.
    pub base_link: String,
    /// Link that carries the tool.
    pub tip_link: String,
    /// Names of the moving joints, base to tip.
    pub joint_names: Vec<String>,
    /// Torque limits, N m, where the file has them.
    pub efforts_nm: Vec<Option<f64>>,
    /// The arm's base frame in the base link's frame.
    pub base_from_arm_base: Isometry3<f64>,
    /// The tip link's frame in the frame of the arm's last link.
    pub last_from_tip: Isometry3<f64>,
    /// What was assumed.
    pub notes: Vec<Note>,
}

impl UrdfArm {
    /// The pose of the tip link in the base link's frame at joint angles `q` (rad).
    ///
    /// # Errors
    /// As [`Arm::forward`].
    pub fn forward(&self, q: &[f64]) -> Result<Isometry3<f64>, ArmError> {
        Ok(self.base_from_arm_base * self.arm.forward(q)? * self.last_from_tip)
    }

    /// The tool whose tip is the tip link's origin and whose approach axis is given in that link.
    pub fn tool(&self, axis_in_tip: &Unit<Vector3<f64>>) -> Tool {
        Tool {
            tip_in_link: self.last_from_tip.translation.vector,
            axis_in_link: self.last_from_tip.rotation * axis_in_tip,
        }
    }
}

impl Urdf {
    /// The arm between two links.
    ///
    /// # Errors
    /// [`UrdfError::Chain`] when the links are not there, not one below the other, or have not 4 to 7
    /// moving joints between them; [`UrdfError::Text`] with its line for a joint that cannot be used.
    pub fn arm(&self, options: &ChainOptions) -> Result<UrdfArm, UrdfError> {
        let mut parent_joints: Vec<Option<usize>> = vec![None; self.links.len()];
        for (i, joint) in self.joints.iter().enumerate() {
            parent_joints[joint.child] = Some(i);
        }
        let base = match &options.base {
            Some(name) => self.link(name)?,
            None => self.root(&parent_joints)?,
        };
        let (tip, chain) = match &options.tip {
            Some(name) => {
                let tip = self.link(name)?;
                let chain = self.chain(&parent_joints, base, tip).ok_or_else(|| {
                    let (base, tip) = (&self.links[base].name, &self.links[tip].name);
                    self.refused(format!("link `{tip}` is not carried by link `{base}`"))
                })?;
                (tip, chain)
            }
            None => self.only_tip(&parent_joints, base)?,
        };
        self.convert(base, tip, &chain, options)
    }

    fn refused(&self, message: String) -> UrdfError {
        UrdfError::Chain {
            file: self.file.clone(),
            message,
        }
    }

    fn joint_error(&self, joint: &UrdfJoint, message: String) -> UrdfError {
        UrdfError::Text {
            file: self.file.clone(),
            line: joint.line,
            column: 1,
            message: format!("joint `{}` {message}", joint.name),
        }
    }

    fn link(&self, name: &str) -> Result<usize, UrdfError> {
        let found = self.links.iter().position(|l| l.name == name);
        found.ok_or_else(|| {
            let names = listed(self.links.iter().map(|l| l.name.as_str()));
            self.refused(format!("no link `{name}`; the links are {names}"))
        })
    }

    fn root(&self, parent_joints: &[Option<usize>]) -> Result<usize, UrdfError> {
        let roots: Vec<usize> = (0..self.links.len())
            .filter(|&l| parent_joints[l].is_none())
            .collect();
        match roots[..] {
            [root] => Ok(root),
            [] => Err(self.refused("no link is without a parent: the joints form a loop".into())),
            _ => {
                let names = listed(roots.iter().map(|&l| self.links[l].name.as_str()));
                Err(self.refused(format!(
                    "several links have no parent, name the base (--base): {names}"
                )))
            }
        }
    }

    /// The joints from `base` to `tip`, or nothing if `base` does not carry `tip`.
    fn chain(
        &self,
        parent_joints: &[Option<usize>],
        base: usize,
        tip: usize,
    ) -> Option<Vec<usize>> {
        let (mut chain, mut link) = (Vec::new(), tip);
        while link != base {
            // A loop has no end.
            if chain.len() > self.joints.len() {
                return None;
            }
            let joint = parent_joints[link]?;
            chain.push(joint);
            link = self.joints[joint].parent;
        }
        chain.reverse();
        Some(chain)
    }

    fn moving(&self, chain: &[usize]) -> usize {
        let joints = chain.iter().map(|&j| &self.joints[j]);
        joints.filter(|j| j.kind != JointKind::Fixed).count()
    }

    fn only_tip(
        &self,
        parent_joints: &[Option<usize>],
        base: usize,
    ) -> Result<(usize, Vec<usize>), UrdfError> {
        let mut has_child = vec![false; self.links.len()];
        for joint in &self.joints {
            has_child[joint.parent] = true;
        }
        let mut ends: Vec<(usize, Vec<usize>)> = (0..self.links.len())
            .filter(|&l| !has_child[l])
            .filter_map(|l| Some((l, self.chain(parent_joints, base, l)?)))
            .collect();
        let counted = |(link, chain): &(usize, Vec<usize>)| {
            let name = &self.links[*link].name;
            let n = self.moving(chain);
            format!("{name} ({n} moving joint{})", if n == 1 { "" } else { "s" })
        };
        let is_arm = |chain: &[usize]| (MIN_JOINTS..=MAX_JOINTS).contains(&self.moving(chain));
        let arms: Vec<usize> = (0..ends.len()).filter(|&n| is_arm(&ends[n].1)).collect();
        // The ends that a moving joint of the first arm carries too: fingers, a camera at the elbow.
        let moved: Vec<usize> = arms.first().map_or_else(Vec::new, |&n| {
            let joints = ends[n].1.iter().copied();
            let moving = joints.filter(|&j| self.joints[j].kind != JointKind::Fixed);
            moving.collect()
        });
        let may = |n: usize| {
            arms.is_empty() || arms.contains(&n) || ends[n].1.iter().any(|j| moved.contains(j))
        };
        let names: Vec<String> = (0..ends.len())
            .filter(|&n| may(n))
            .map(|n| counted(&ends[n]))
            .collect();
        let listed = listed(names.iter().map(String::as_str));
        match (arms.len(), names.len()) {
            (1, 1) => Ok(ends.swap_remove(arms[0])),
            (0, _) => Err(self.refused(format!(
                "no end of an arm of {MIN_JOINTS} to {MAX_JOINTS} joints; the ends are {listed}; a \
                 link that is no end, such as a gripper's base, can be named as the tip (--tip)"
            ))),
            _ => Err(self.refused(format!(
                "several ends may carry the tool, name the tip (--tip): {listed}; a link that is no \
                 end, such as a gripper's base, can be it too"
            ))),
        }
    }

    fn convert(
        &self,
        base: usize,
        tip: usize,
        chain: &[usize],
        options: &ChainOptions,
    ) -> Result<UrdfArm, UrdfError> {
        let mut here = Isometry3::identity();
        let (mut lines, mut limits, mut notes) = (Vec::new(), Vec::new(), Vec::new());
        let (mut joint_names, mut efforts_nm) = (Vec::new(), Vec::new());
        for joint in chain.iter().map(|&j| &self.joints[j]) {
            here *= joint.parent_from_joint;
            match joint.kind {
                JointKind::Fixed => continue,
                JointKind::Revolute | JointKind::Continuous => {}
                JointKind::Prismatic | JointKind::Floating | JointKind::Planar => {
                    let message = format!(
                        "of the chain is {:?}, expected revolute, continuous or fixed",
                        joint.kind
                    );
                    return Err(self.joint_error(joint, message.to_lowercase()));
                }
            }
            if let Some(other) = &joint.mimics {
                let message = format!("of the chain mimics `{other}`: it has no angle of its own");
                return Err(self.joint_error(joint, message));
            }
            lines.push(Line {
                point: here.translation.vector,
                direction: (here.rotation * joint.axis).into_inner(),
            });
            limits.push(self.limits(joint, options, &mut notes)?);
            joint_names.push(joint.name.clone());
            efforts_nm.push(joint.limits.effort_nm);
        }
        if !(MIN_JOINTS..=MAX_JOINTS).contains(&lines.len()) {
            return Err(self.refused(format!(
                "{} moving joints from `{}` to `{}`, expected {MIN_JOINTS} to {MAX_JOINTS}",
                lines.len(),
                self.links[base].name,
                self.links[tip].name
            )));
        }
        let found = rows(&lines);
        let arm = Arm::with_tilts(found.rows, found.tilts_rad, limits)
            .map_err(|e| self.refused(e.to_string()))?;
        Ok(UrdfArm {
            arm,
            base_link: self.links[base].name.clone(),
            tip_link: self.links[tip].name.clone(),
            joint_names,
            efforts_nm,
            base_from_arm_base: found.base_from_arm_base,
            last_from_tip: found.base_from_last.inverse() * here,
            notes,
        })
    }

    fn limits(
        &self,
        joint: &UrdfJoint,
        options: &ChainOptions,
        notes: &mut Vec<Note>,
    ) -> Result<JointLimits, UrdfError> {
        let mut note = |message: String| {
            notes.push(Note {
                line: joint.line,
                message: format!("joint `{}` {message}", joint.name),
            });
        };
        let given = &joint.limits;
        let (lower_rad, upper_rad) = if joint.kind == JointKind::Continuous {
            note("has no limits: one turn to either side is used".into());
            (-ENDLESS_RAD, ENDLESS_RAD)
        } else {
            // The format: absent means zero.
            let (lower, upper) = (
                given.lower_rad.unwrap_or(0.0),
                given.upper_rad.unwrap_or(0.0),
            );
            if lower >= upper {
                let message = format!("has limits {lower} to {upper} rad, expected lower < upper");
                return Err(self.joint_error(joint, message));
            }
            (lower, upper)
        };
        let rate = match given.velocity_rad_s.filter(|v| *v > 0.0) {
            Some(rate) => rate,
            // Not needed before a motion is timed, as with the acceleration.
            None => {
                let rate = options.max_rate_rad_s;
                let said = rate.map_or("none is used".into(), |r| format!("{r} rad/s as given"));
                note(format!("has no rate limit in the file: {said}"));
                rate.unwrap_or(NO_RATE_LIMIT_RAD_S)
            }
        };
        Ok(JointLimits {
            lower_rad,
            upper_rad,
            max_rate_rad_s: rate,
            // Not needed before a motion is timed; what asks for one names the option.
            max_acceleration_rad_s2: options.max_acceleration_rad_s2.unwrap_or(f64::MAX),
        })
    }
}

fn listed<'a>(names: impl Iterator<Item = &'a str>) -> String {
    const MOST: usize = 20;
    let names: Vec<&str> = names.collect();
    let more = names.len().saturating_sub(MOST);
    let mut text = names[..names.len() - more].join(", ");
    if more > 0 {
        text.push_str(&format!(" and {more} more"));
    }
    if text.is_empty() { "none".into() } else { text }
}
