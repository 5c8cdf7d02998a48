//! URDF input: forward kinematics against an independent reader of the format, and refusals.
#![allow(clippy::unwrap_used, clippy::expect_used)]
// Angles as files write them, with the digits that they give.
#![allow(clippy::approx_constant)]

use k::nalgebra as other;
use nalgebra::{Isometry3, UnitQuaternion, Vector3};
use proptest::prelude::*;
use rover_kinematics::{AxisGoal, NO_RATE_LIMIT_RAD_S, solve_axis};
use rover_robot::urdf::{ChainOptions, Urdf, UrdfArm};
use std::fmt::Write;
use std::path::{Path, PathBuf};

fn parse(text: &str) -> Result<Urdf, String> {
    Urdf::parse(text, "arm.urdf", Path::new("."), &[]).map_err(|e| e.to_string())
}

fn arm(text: &str) -> Result<UrdfArm, String> {
    let options = ChainOptions::default();
    parse(text)?.arm(&options).map_err(|e| e.to_string())
}

/// A joint of a made-up chain.
#[derive(Clone, Debug)]
struct Joint {
    xyz: [f64; 3],
    rpy: [f64; 3],
    axis: [f64; 3],
    is_fixed: bool,
}

fn urdf(joints: &[Joint]) -> String {
    let mut text =
        String::from("<?xml version=\"1.0\"?>\n<robot name=\"r\">\n<link name=\"l0\"/>\n");
    for (i, j) in joints.iter().enumerate() {
        let three = |v: [f64; 3]| format!("{} {} {}", v[0], v[1], v[2]);
        let kind = if j.is_fixed { "fixed" } else { "revolute" };
        let n = i + 1;
        writeln!(text, "<link name=\"l{n}\"/>").unwrap();
        writeln!(text, "<joint name=\"j{n}\" type=\"{kind}\">").unwrap();
        writeln!(text, "<parent link=\"l{i}\"/><child link=\"l{n}\"/>").unwrap();
        writeln!(
            text,
            "<origin xyz=\"{}\" rpy=\"{}\"/>",
            three(j.xyz),
            three(j.rpy)
        )
        .unwrap();
        writeln!(text, "<axis xyz=\"{}\"/>", three(j.axis)).unwrap();
        writeln!(
            text,
            "<limit lower=\"-3\" upper=\"3\" velocity=\"1\" effort=\"10\"/>"
        )
        .unwrap();
        writeln!(text, "</joint>").unwrap();
    }
    text + "</robot>\n"
}

/// The end of the chain by the crate `k`.
fn reference(text: &str, q: &[f64]) -> Isometry3<f64> {
    let robot = urdf_rs::read_from_string(text).unwrap();
    let chain = k::Chain::<f64>::from(&robot);
    let end = chain.iter().last().unwrap().clone();
    let serial = k::SerialChain::from_end(&end);
    serial.set_joint_positions(q).unwrap();
    let pose: other::Isometry3<f64> = serial.end_transform();
    let (t, r) = (pose.translation.vector, pose.rotation);
    Isometry3::from_parts(
        Vector3::new(t.x, t.y, t.z).into(),
        UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(r.w, r.i, r.j, r.k)),
    )
}

fn assert_same(text: &str, q: &[f64]) {
    let arm = arm(text).unwrap();
    let (ours, theirs) = (arm.forward(q).unwrap(), reference(text, q));
    let apart = (ours.translation.vector - theirs.translation.vector).norm();
    let turned = ours.rotation.angle_to(&theirs.rotation);
    assert!(
        apart < 1e-9 && turned < 1e-9,
        "{apart:e} m, {turned:e} rad\n{text}"
    );
}

fn coordinate() -> impl Strategy<Value = f64> {
    prop_oneof![Just(0.0), -0.6..0.6f64]
}

/// Right angles as files write them, and others.
fn angle() -> impl Strategy<Value = f64> {
    let quarter = std::f64::consts::FRAC_PI_2;
    prop_oneof![
        2 => Just(0.0),
        2 => prop::sample::select(vec![
            quarter, -quarter, 1.57, 1.5708, 1.570796, 1.5707963, -1.570796327, 3.14159, 3.1416,
            1e-3, 1e-5, 1e-7, 1e-9,
        ]),
        1 => -3.2..3.2f64,
    ]
}

fn axis() -> impl Strategy<Value = [f64; 3]> {
    prop_oneof![
        4 => prop::sample::select(vec![
            [0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0],
        ]),
        1 => prop::array::uniform3(-1.0..1.0f64).prop_filter("a direction", |a| {
            Vector3::from(*a).norm() > 0.1
        }),
    ]
}

fn chain() -> impl Strategy<Value = (Vec<Joint>, Vec<f64>)> {
    let joint = (
        prop::array::uniform3(coordinate()),
        prop::array::uniform3(angle()),
        axis(),
        prop::bool::weighted(0.25),
    )
        .prop_map(|(xyz, rpy, axis, is_fixed)| Joint {
            xyz,
            rpy,
            axis,
            is_fixed,
        });
    prop::collection::vec(joint, 4..10)
        .prop_filter("4 to 7 moving joints", |joints| {
            (4..=7).contains(&joints.iter().filter(|j| !j.is_fixed).count())
        })
        .prop_flat_map(|joints| {
            let moving = joints.iter().filter(|j| !j.is_fixed).count();
            (Just(joints), prop::collection::vec(-3.0..3.0f64, moving))
        })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(300))]
    #[test]
    fn forward_kinematics_agrees_with_another_reader((joints, q) in chain()) {
        assert_same(&urdf(&joints), &q);
    }
}

/// Axes that are parallel but for the digits of pi/2 have their common normal kilometres away.
#[test]
fn nearly_parallel_axes_are_exact_and_reach_stays_honest() {
    for tilt in [1.570796, 1.5707963, 1.57079633, 1.5707] {
        let joint = |xyz: [f64; 3], rpy: [f64; 3]| Joint {
            xyz,
            rpy,
            axis: [0.0, 0.0, 1.0],
            is_fixed: false,
        };
        let joints = [
            joint([0.0, 0.0, 0.1], [0.0; 3]),
            joint([0.0, 0.1, 0.0], [tilt, 0.0, 0.0]),
            joint([0.4, 0.1, 0.0], [tilt, tilt, -tilt]),
            joint([0.4, 0.1, 0.05], [-tilt, 0.3, tilt]),
            joint([0.1, 0.2, 0.0], [tilt, 0.0, tilt]),
            joint([0.0, 0.1, 0.1], [tilt, tilt, 0.0]),
        ];
        let text = urdf(&joints);
        let urdf = arm(&text).unwrap();
        let reach = urdf.arm.reach_m(0.0);
        // the origins' distances add up to 1.5 m
        assert!(reach < 1.6, "{reach}");
        for i in 0..2000 {
            let q: Vec<f64> = (0..6)
                .map(|j| (f64::from(i * 7 + j) * 0.377).sin() * 3.0)
                .collect();
            let tip = urdf.arm.forward(&q).unwrap().translation.vector.norm();
            assert!(tip <= reach + 1e-12, "{tip} {reach}");
        }
        for i in 0..50 {
            let q: Vec<f64> = (0..6)
                .map(|j| (f64::from(i * 7 + j) * 0.77).sin() * 3.0)
                .collect();
            assert_same(&text, &q);
        }
    }
}

/// The flight arm, written as a URDF from its table: each row's constant part is the next origin.
const FLIGHT_ARM: &str = include_str!("flight_arm.urdf");

#[test]
fn the_flight_arm_as_urdf_has_its_reference_poses_and_the_closed_form() {
    let arm = arm(FLIGHT_ARM).unwrap();
    // Encoder angles, and tool positions in the rover frame computed from the flight software's own
    // values; the arm's base stands at (0.56245, -0.1599, -0.18654).
    let base = Vector3::new(0.56245, -0.1599, -0.18654);
    for (q, expected) in [(
        [-0.11828, -0.803972, 1.76256, 0.709861, 1.49277],
        [1.13066634819088, -0.13805530358304224, 0.014808672455681224],
    )] {
        let pose = arm.forward(&q).unwrap();
        let apart = (pose.translation.vector + base - Vector3::from(expected)).norm();
        assert!(apart < 1e-9, "{apart:e}");
        let tool = arm.tool(&Vector3::z_axis());
        let goal = AxisGoal::at(&arm.arm, &tool, &q).unwrap();
        let branches = solve_axis(&arm.arm, &tool, &goal).unwrap();
        let distance = |a: &[f64]| {
            a.iter()
                .zip(&q)
                .map(|(a, b)| (a - b).abs())
                .fold(0.0, f64::max)
        };
        assert!(branches.iter().any(|b| distance(&b.joints_rad) < 1e-7));
        for branch in &branches {
            let there = arm.forward(&branch.joints_rad).unwrap();
            assert!((there.translation.vector - pose.translation.vector).norm() < 1e-9);
            let axes = (there.rotation * Vector3::z()).angle(&(pose.rotation * Vector3::z()));
            assert!(axes < 1e-7, "{axes:e}");
        }
    }
}

#[test]
fn what_concerns_the_chain_is_refused_with_its_line() {
    let good = FLIGHT_ARM;
    let line_of = |part: &str| {
        let at = good.find(part).unwrap_or_else(|| panic!("{part}"));
        good[..at].lines().count().max(1)
    };
    let shoulder = line_of("<joint name=\"shoulder_azimuth\"");
    for (from, to, line, part) in [
        (
            "type=\"revolute\"",
            "type=\"prismatic\"",
            shoulder,
            "is prismatic",
        ),
        (
            "type=\"revolute\"",
            "type=\"floating\"",
            shoulder,
            "is floating",
        ),
        ("type=\"revolute\"", "type=\"hinge\"", shoulder, "`hinge`"),
        (
            "upper=\"3.2\"",
            "upper=\"-4\"",
            shoulder,
            "expected lower < upper",
        ),
        (
            "upper=\"3.2\"",
            "upper=\"nan\"",
            0,
            "expected a finite number",
        ),
        (
            "<axis xyz=\"0 0 1\"/>",
            "<axis xyz=\"0 0 0\"/>",
            0,
            "the axis is",
        ),
        (
            "<axis xyz=\"0 0 1\"/>",
            "<axis xyz=\"0 0\"/>",
            0,
            "3 finite numbers",
        ),
        (
            "<axis xyz=\"0 0 1\"/>",
            "<axis xyz=\"0 0 1\"/><axis xyz=\"0 0 1\"/>",
            0,
            "a second <axis>",
        ),
        (
            "<child link=\"upper_arm\"/>",
            "<child link=\"nowhere\"/>",
            0,
            "there is no link `nowhere`",
        ),
        (
            "<child link=\"upper_arm\"/>",
            "<child link=\"base\"/>",
            0,
            "",
        ),
        ("<robot name=", "<machine name=", 0, ""),
        ("</robot>", "", 0, ""),
        (
            "<limit ",
            "<mimic joint=\"elbow\"/><limit ",
            shoulder,
            "mimics `elbow`",
        ),
    ] {
        assert!(good.contains(from), "{from}");
        let message = arm(&good.replacen(from, to, 1)).unwrap_err();
        assert!(message.starts_with("arm.urdf:"), "{message}");
        assert!(message.contains(part), "{to}: {message}");
        if line > 0 {
            assert!(
                message.starts_with(&format!("arm.urdf:{line}:")),
                "{line}: {message}"
            );
        }
    }
    let macros =
        "<robot name=\"r\" xmlns:xacro=\"http://www.ros.org/wiki/xacro\">\n<xacro:arm/></robot>";
    let message = parse(macros).unwrap_err();
    assert!(
        message.starts_with("arm.urdf:2:") && message.contains("xacro"),
        "{message}"
    );
    let bomb = "<!DOCTYPE r [<!ENTITY a \"aaaa\"><!ENTITY b \"&a;&a;\">]>\n<robot name=\"&b;\"/>";
    assert!(parse(bomb).unwrap_err().starts_with("arm.urdf:1:"));
}

#[test]
fn a_joint_without_a_rate_limit_is_said_and_has_none() {
    let (from, to) = ("velocity=\"0.1\"", "velocity=\"0\"");
    assert!(FLIGHT_ARM.contains(from));
    let urdf = parse(&FLIGHT_ARM.replacen(from, to, 1)).unwrap();
    let found = urdf.arm(&ChainOptions::default()).unwrap();
    let rates: Vec<f64> = found
        .arm
        .limits()
        .iter()
        .map(|l| l.max_rate_rad_s)
        .collect();
    assert_eq!(rates[0], NO_RATE_LIMIT_RAD_S);
    assert!(rates[1] < NO_RATE_LIMIT_RAD_S);
    let said = found
        .notes
        .iter()
        .any(|n| n.message.contains("no rate limit"));
    assert!(said, "{:?}", found.notes);
    let given = urdf.arm(&ChainOptions {
        max_rate_rad_s: Some(0.5),
        ..Default::default()
    });
    assert_eq!(given.unwrap().arm.limits()[0].max_rate_rad_s, 0.5);
}

/// Neither depth nor length may overrun the reader.
#[test]
fn deep_and_long_files_are_refused_or_read_in_time() {
    let deep = format!("<robot name=\"r\">{}", "<a>".repeat(100_000));
    assert!(parse(&deep).unwrap_err().starts_with("arm.urdf:1:"));
    let links: String = (0..20_000)
        .map(|i| format!("<link name=\"l{i}\"/>\n"))
        .collect();
    let long = format!("<robot name=\"r\">\n{links}</robot>");
    let message = arm(&long).unwrap_err();
    assert!(
        message.contains("several links have no parent"),
        "{message}"
    );
    assert!(message.len() < 1000);
}

#[test]
fn base_and_tip_are_chosen_by_name_or_because_there_is_only_one() {
    let urdf = parse(FLIGHT_ARM).unwrap();
    let ask = |base: Option<&str>, tip: Option<&str>| {
        let options = ChainOptions {
            base: base.map(Into::into),
            tip: tip.map(Into::into),
            ..Default::default()
        };
        urdf.arm(&options).map_err(|e| e.to_string())
    };
    let whole = ask(None, None).unwrap();
    assert_eq!(
        (whole.base_link.as_str(), whole.tip_link.as_str()),
        ("base", "imager")
    );
    assert_eq!(whole.joint_names[2], "elbow");
    let short = ask(Some("shoulder"), Some("imager")).unwrap();
    assert_eq!(short.arm.joint_count(), 4);
    assert!(
        ask(None, Some("imger"))
            .unwrap_err()
            .contains("no link `imger`; the links are base")
    );
    assert!(
        ask(Some("imager"), Some("base"))
            .unwrap_err()
            .contains("is not carried by")
    );
    assert!(
        ask(None, Some("forearm"))
            .unwrap_err()
            .contains("3 moving joints")
    );
    let two = FLIGHT_ARM.replace(
        "</robot>",
        "<link name=\"eye\"/><joint name=\"e\" type=\"fixed\"><parent link=\"turret\"/><child link=\"eye\"/></joint></robot>",
    );
    let message = arm(&two).unwrap_err();
    assert!(
        message.contains("imager (5 moving joints), eye (5 moving joints)"),
        "{message}"
    );
}

#[test]
fn what_has_no_part_in_the_arm_is_reported_with_its_line() {
    let text = FLIGHT_ARM.replace(
        "</robot>",
        "<transmission name=\"t\"/>\n<gazebo/>\n</robot>",
    );
    let notes = parse(&text).unwrap().notes;
    let lines = text.lines().count();
    assert_eq!(notes.len(), 2, "{notes:?}");
    assert!(notes[0].message.contains("<transmission>"));
    assert_eq!(notes[0].line as usize, lines - 2);
}

#[test]
fn meshes_are_found_beside_the_file_and_in_packages() {
    let folder = tempfile::tempdir().unwrap();
    let packages = folder.path().join("share");
    std::fs::create_dir_all(packages.join("idd/meshes")).unwrap();
    std::fs::write(packages.join("idd/meshes/a.stl"), "x").unwrap();
    std::fs::write(folder.path().join("b.stl"), "x").unwrap();
    let mesh = |name: &str| {
        format!("<collision><geometry><mesh filename=\"{name}\"/></geometry></collision>")
    };
    let body = [
        "package://idd/meshes/a.stl",
        "b.stl",
        "package://idd/meshes/c.stl",
    ]
    .map(mesh);
    let text = format!(
        "<robot name=\"r\"><link name=\"l\">{}</link></robot>",
        body.concat()
    );
    let path = folder.path().join("r.urdf");
    std::fs::write(&path, text).unwrap();
    let found = |roots: &[PathBuf]| -> Vec<bool> {
        let urdf = Urdf::read(&path, roots).unwrap();
        urdf.meshes.iter().map(|m| m.path.is_some()).collect()
    };
    assert_eq!(found(&[]), [false, true, false]);
    assert_eq!(found(std::slice::from_ref(&packages)), [true, true, false]);
    assert_eq!(found(&[packages.join("idd")]), [true, true, false]);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]
    #[test]
    fn a_damaged_file_is_read_or_refused_with_its_line(
        at in 0.0..1.0f64, length in 0usize..60, with in "[ -~]{0,12}",
    ) {
        let bytes = FLIGHT_ARM.as_bytes();
        let start = (at * bytes.len() as f64) as usize;
        let end = (start + length).min(bytes.len());
        let damaged = [&bytes[..start], with.as_bytes(), &bytes[end..]].concat();
        let text = String::from_utf8_lossy(&damaged);
        match arm(&text) {
            Ok(arm) => {
                let q = vec![0.1; arm.arm.joint_count()];
                prop_assert!(arm.forward(&q).unwrap().translation.vector.norm().is_finite());
            }
            Err(message) => prop_assert!(message.starts_with("arm.urdf:"), "{}", message),
        }
    }

    #[test]
    fn any_text_is_refused_without_a_panic(text in "\\PC{0,200}") {
        if let Err(message) = parse(&text) {
            prop_assert!(message.starts_with("arm.urdf:"), "{}", message);
        }
    }
}
