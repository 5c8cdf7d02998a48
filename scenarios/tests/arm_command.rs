//! `rover arm` on one's own files: reference poses, tables, refusals.

#![allow(clippy::unwrap_used, clippy::expect_used)]
// Angles as the table writes them.
#![allow(clippy::approx_constant)]

use std::{
    io::Write,
    path::Path,
    process::{Command, Output, Stdio},
};

const BLUESTREAK: &str = include_str!("../robots/bluestreak.toml");
const FLIGHT_URDF: &str = include_str!("../../common/robot/tests/flight_arm.urdf");

fn rover(folder: &Path, args: &[&str], input: &str) -> Output {
    let mut child = Command::new(env!("CARGO_BIN_EXE_rover"))
        .arg("arm")
        .args(args)
        .current_dir(folder)
        .env_remove("RUST_LOG")
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    // A command that refuses its arguments does not read.
    let _ = child.stdin.take().unwrap().write_all(input.as_bytes());
    child.wait_with_output().unwrap()
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

fn done(folder: &Path, args: &[&str], input: &str) -> String {
    let out = rover(folder, args, input);
    assert_eq!(
        out.status.code(),
        Some(0),
        "{args:?}: {}",
        text(&out.stderr)
    );
    text(&out.stdout)
}

fn refused(folder: &Path, args: &[&str], input: &str, parts: &[&str]) {
    let out = rover(folder, args, input);
    let stderr = text(&out.stderr);
    assert_eq!(out.status.code(), Some(2), "{args:?}: {stderr}");
    assert!(out.stdout.is_empty(), "{args:?}: {}", text(&out.stdout));
    for part in parts {
        assert!(stderr.contains(part), "{args:?}: `{part}` in: {stderr}");
    }
}

/// The cells of a table's rows, without the header.
fn rows(table: &str) -> Vec<Vec<String>> {
    let mut reader = csv::Reader::from_reader(table.as_bytes());
    let rows = reader.records().map(|r| r.unwrap());
    rows.map(|r| r.iter().map(str::to_owned).collect())
        .collect()
}

fn numbers(cells: &[String]) -> Vec<f64> {
    cells.iter().map(|c| c.parse().unwrap()).collect()
}

/// The flight arm with one of its tools: length, m, and angle about the last link's y, rad.
fn flight_robot(length: f64, angle: f64) -> String {
    let (s, c) = angle.sin_cos();
    BLUESTREAK
        .replace(
            "tip_m = [0.0, 0.0, 0.1306]",
            &format!("tip_m = [{}, 0.0, {}]", length * s, length * c),
        )
        .replace("axis = [0.0, 0.0, 1.0]", &format!("axis = [{s}, 0.0, {c}]"))
}

/// Three products of the rover Opportunity: encoder angles, and the tool's pose in the rover frame by
/// the flight software's own equations and calibration. There the arm's base is at `BASE`, unturned.
const BASE: [f64; 3] = [0.56245, -0.1599, -0.18654];
type Reference = ((f64, f64), [f64; 5], [f64; 3], [[f64; 3]; 3]);
const REFERENCES: [Reference; 3] = [
    (
        (0.1293, 4.7124),
        [-0.11828, -0.899795, 2.47065, 1.57119, -1.571],
        [
            0.8696018148805936,
            0.03342951125479521,
            -0.007467756314635139,
        ],
        [
            [
                0.9930356861360231,
                0.00044918588317348904,
                0.11781309049676968,
            ],
            [
                -0.11781307840432831,
                -5.337886499823177e-05,
                0.993035787727508,
            ],
            [
                0.0004523463863859136,
                -0.9999998976913643,
                -8.714615624551447e-08,
            ],
        ],
    ),
    (
        (0.1293, 4.7124),
        [-0.11828, -0.899801, 0.500046, 1.57045, -1.57096],
        [
            1.2424063375042267,
            -0.010872597572258058,
            -0.5735437103947691,
        ],
        [
            [
                -0.3867721602558545,
                -0.9145864198122066,
                0.11806344373306218,
            ],
            [0.04611567728208484, 0.10868459330792528, 0.9930060440331194],
            [
                -0.921021520030794,
                0.38951166846781526,
                0.000140597242401839,
            ],
        ],
    ),
    (
        (0.1306, 0.0),
        [-0.11828, -0.803972, 1.76256, 0.709861, 1.49277],
        [1.13066634819088, -0.13805530358304224, 0.014808672455681224],
        [
            [
                0.11009881044508778,
                -0.9882821250590201,
                -0.1057198809467922,
            ],
            [
                0.9908886133506671,
                0.11744219956555514,
                -0.06593243278688068,
            ],
            [
                0.07757582014112936,
                -0.09749754381537826,
                0.9922077509672053,
            ],
        ],
    ),
];

fn joints_table(q: &[f64]) -> String {
    let header: Vec<_> = (1..=q.len()).map(|i| format!("q{i}_rad")).collect();
    let cells: Vec<_> = q.iter().map(f64::to_string).collect();
    format!("{}\n{}\n", header.join(","), cells.join(","))
}

fn assert_pose(cells: &[f64], position: &[f64; 3], rotation: &[[f64; 3]; 3]) {
    for i in 0..3 {
        assert!((cells[i] + BASE[i] - position[i]).abs() < 1e-9, "{cells:?}");
    }
    let [w, x, y, z] = cells[3..7] else {
        panic!("{cells:?}")
    };
    let ours = [
        [
            1.0 - 2.0 * (y * y + z * z),
            2.0 * (x * y - w * z),
            2.0 * (x * z + w * y),
        ],
        [
            2.0 * (x * y + w * z),
            1.0 - 2.0 * (x * x + z * z),
            2.0 * (y * z - w * x),
        ],
        [
            2.0 * (x * z - w * y),
            2.0 * (y * z + w * x),
            1.0 - 2.0 * (x * x + y * y),
        ],
    ];
    for (a, b) in ours.as_flattened().iter().zip(rotation.as_flattened()) {
        assert!((a - b).abs() < 1e-9, "{ours:?}");
    }
}

#[test]
fn the_flight_arm_has_its_reference_poses() {
    let folder = tempfile::tempdir().unwrap();
    for (tool, q, position, rotation) in REFERENCES {
        std::fs::write(folder.path().join("arm.toml"), flight_robot(tool.0, tool.1)).unwrap();
        let table = done(folder.path(), &["fk", "arm.toml", "-"], &joints_table(&q));
        assert!(
            table.starts_with("x_m,y_m,z_m,qw,qx,qy,qz,status\n"),
            "{table}"
        );
        assert_pose(&numbers(&rows(&table)[0][..7]), &position, &rotation);
    }
    // The same arm with its microscope, as a URDF.
    std::fs::write(folder.path().join("arm.urdf"), FLIGHT_URDF).unwrap();
    let (_, q, position, rotation) = REFERENCES[2];
    let table = done(folder.path(), &["fk", "arm.urdf", "-"], &joints_table(&q));
    assert_pose(&numbers(&rows(&table)[0][..7]), &position, &rotation);
}

const TARGETS: &str = "x_m,y_m,z_m,ax,ay,az\n0.45,0.1,0.2,0,0,1\n5,0,0,0,0,1\n0.4,0.2,0.25,0.3,0,2\n0.4,0.1,0.2,0,0,0\n";

#[test]
fn answers_of_the_inverse_lead_back_to_their_targets() {
    let folder = tempfile::tempdir().unwrap();
    let robot = "robots/bluestreak.toml";
    let joints = done(folder.path(), &["ik", robot, "-"], TARGETS);
    assert!(
        joints.starts_with("q1_rad,q2_rad,q3_rad,q4_rad,q5_rad,status\n"),
        "{joints}"
    );
    let answers = rows(&joints);
    assert_eq!(answers.len(), 4);
    assert!(
        answers[1][5].contains("out of reach") && answers[1][5].contains("mm"),
        "{joints}"
    );
    assert!(answers[3][5].contains("axis ax,ay,az is zero"), "{joints}");
    // The reasons are handed on.
    let poses = rows(&done(folder.path(), &["fk", robot, "-"], &joints));
    assert_eq!(poses[1][7], answers[1][5]);
    for (i, target) in [(0, [0.45, 0.1, 0.2]), (2, [0.4, 0.2, 0.25])] {
        let pose = numbers(&poses[i][..7]);
        for k in 0..3 {
            assert!((pose[k] - target[k]).abs() < 1e-9, "{pose:?}");
        }
    }
    let stderr = text(&rover(folder.path(), &["ik", robot, "-"], TARGETS).stderr);
    assert!(stderr.contains("2 of 4 rows have no answer"), "{stderr}");
}

#[test]
fn all_branches_name_the_row_they_answer() {
    let folder = tempfile::tempdir().unwrap();
    let table = done(
        folder.path(),
        &["ik", "bluestreak.toml", "-", "--all"],
        TARGETS,
    );
    assert!(table.starts_with("row,q1_rad,"), "{table}");
    let answers = rows(&table);
    let of = |row: &str| answers.iter().filter(|r| r[0] == row).count();
    assert!(
        of("1") >= 2 && of("2") == 1 && of("3") >= 2 && of("4") == 1,
        "{table}"
    );
    let refused = answers.iter().find(|r| r[0] == "2").unwrap();
    assert!(refused[1].is_empty() && refused[6].contains("out of reach"));
    // Every branch is an answer.
    let first: Vec<_> = answers.iter().filter(|r| r[0] == "1").collect();
    for branch in first {
        let q = numbers(&branch[1..6]);
        let fk = ["fk", "bluestreak.toml", "-"];
        let pose = numbers(&rows(&done(folder.path(), &fk, &joints_table(&q)))[0][..7]);
        assert!((pose[0] - 0.45).abs() < 1e-9 && (pose[2] - 0.2).abs() < 1e-9);
    }
}

/// A made-up arm of six joints.
fn six_joints() -> String {
    let mut text = String::from("<robot name=\"six\">\n<link name=\"l0\"/>\n");
    for (i, (xyz, axis)) in [
        ("0 0 0.2", "0 0 1"),
        ("0 0.1 0", "0 1 0"),
        ("0 0 0.4", "0 1 0"),
        ("0.05 0 0.35", "0 0 1"),
        ("0 0 0.05", "0 1 0"),
        ("0 0 0.08", "0 0 1"),
    ]
    .into_iter()
    .enumerate()
    {
        let n = i + 1;
        text += &format!(
            "<link name=\"l{n}\"/>\n<joint name=\"j{n}\" type=\"revolute\"><parent link=\"l{i}\"/>\
             <child link=\"l{n}\"/><origin xyz=\"{xyz}\"/><axis xyz=\"{axis}\"/>\
             <limit lower=\"-2.9\" upper=\"2.9\" velocity=\"1\" effort=\"1\"/></joint>\n"
        );
    }
    text + "</robot>\n"
}

#[test]
fn an_arm_of_six_joints_takes_whole_poses() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("six.urdf"), six_joints()).unwrap();
    let q = [0.3, -0.5, 0.9, 0.4, 0.7, -0.6];
    let poses = done(folder.path(), &["fk", "six.urdf", "-"], &joints_table(&q));
    let wanted = numbers(&rows(&poses)[0][..7]);
    for more in [&["--pose"][..], &["--pose", "--all"]] {
        let args = [&["ik", "six.urdf", "-"], more].concat();
        let answers = done(folder.path(), &args, &poses);
        let first = usize::from(more.len() > 1);
        for row in rows(&answers) {
            assert_eq!(row.last().unwrap(), "ok", "{answers}");
            let q = numbers(&row[first..first + 6]);
            let again = done(folder.path(), &["fk", "six.urdf", "-"], &joints_table(&q));
            for (a, b) in numbers(&rows(&again)[0][..7]).iter().zip(&wanted) {
                assert!((a - b).abs() < 1e-8, "{again}");
            }
        }
    }
}

#[test]
fn a_plan_is_a_table_within_the_limits() {
    let folder = tempfile::tempdir().unwrap();
    let args = [
        "plan",
        "bluestreak.toml",
        "--from",
        "ready",
        "--to",
        "stow",
        "--step-s",
        "0.1",
        "--out",
        "plan.csv",
        "--json",
        "plan.json",
    ];
    done(folder.path(), &args, "");
    let table = std::fs::read_to_string(folder.path().join("plan.csv")).unwrap();
    assert!(
        table.starts_with("t_s,q1_rad,q2_rad,q3_rad,q4_rad,q5_rad,r1_rad_s,"),
        "{table}"
    );
    let rows: Vec<Vec<f64>> = rows(&table).iter().map(|r| numbers(&r[..11])).collect();
    let json = std::fs::read_to_string(folder.path().join("plan.json")).unwrap();
    let summary: serde_json::Value = serde_json::from_str(&json).unwrap();
    assert_eq!(rows[0][1..6], [0.125, -0.969, 1.316, -1.918, -1.5708]);
    let last = rows.last().unwrap();
    assert_eq!(last[1..6], [-1.5, -1.1, 2.2, -2.6708, -1.5708]);
    assert_eq!(summary["duration_s"], last[0]);
    assert_eq!(summary["rows"], rows.len());
    assert!(summary["clearance_m"].as_f64().unwrap() > 0.0);
    for pair in rows.windows(2) {
        assert!(pair[1][0] > pair[0][0]);
        for (joint, rate) in [0.3, 0.3, 0.4, 0.5, 0.5].into_iter().enumerate() {
            let moved = (pair[1][1 + joint] - pair[0][1 + joint]).abs();
            assert!(moved <= rate * (pair[1][0] - pair[0][0]) * 1.001 + 1e-9);
            assert!(pair[0][6 + joint].abs() <= rate * 1.000_01);
        }
    }
    // A tool pose; and what exists is kept.
    let tool = [
        "plan",
        "bluestreak.toml",
        "--from",
        "ready",
        "--to-tool",
        "0.4,0.1,0.15,0,0,1",
    ];
    let table = done(folder.path(), &tool, "");
    assert!(table.lines().count() > 10);
    refused(folder.path(), &args, "", &["plan.json exists", "--force"]);
    let far = [
        "plan",
        "bluestreak.toml",
        "--from",
        "ready",
        "--to-tool",
        "4,0,0,0,0,1",
    ];
    refused(folder.path(), &far, "", &["out of reach"]);
}

#[test]
fn what_an_arm_is_made_of_is_told() {
    let folder = tempfile::tempdir().unwrap();
    let info = done(folder.path(), &["info", "bluestreak.toml"], "");
    for part in [
        "bluestreak: 5 joints",
        "closed form",
        "elbow",
        "posture ready",
    ] {
        assert!(info.contains(part), "{part}: {info}");
    }
    std::fs::write(folder.path().join("arm.urdf"), FLIGHT_URDF).unwrap();
    let json = done(folder.path(), &["info", "arm.urdf", "--json", "-"], "");
    let info: serde_json::Value = serde_json::from_str(&json).unwrap();
    assert_eq!(info["inverse"], "closed form");
    assert_eq!(info["joints"][2]["name"], "elbow");
    assert!((info["joints"][1]["a_m"].as_f64().unwrap() - 0.353552).abs() < 1e-12);
    std::fs::write(folder.path().join("six.urdf"), six_joints()).unwrap();
    let info = done(folder.path(), &["info", "six.urdf"], "");
    assert!(
        info.contains("numeric: number of joints = 6, expected 5"),
        "{info}"
    );
}

#[test]
fn bad_input_is_refused_with_file_and_line() {
    let folder = tempfile::tempdir().unwrap();
    let robot = "bluestreak.toml";
    let fk = ["fk", robot, "-"];
    refused(
        folder.path(),
        &fk,
        "q1_rad,q2_rad\n",
        &["standard input:1", "no column `q3_rad`"],
    );
    let bad = joints_table(&[0.0; 5]) + "0,0,x,0,0\n";
    let out = rover(folder.path(), &fk, &bad);
    assert_eq!(out.status.code(), Some(2));
    assert!(text(&out.stderr).contains("standard input:3:3: `q3_rad` is `x`"));
    refused(
        folder.path(),
        &["fk", "nobody.toml", "-"],
        "",
        &["nobody.toml"],
    );
    refused(folder.path(), &["fk", "none.urdf", "-"], "", &["none.urdf"]);
    let urdf = FLIGHT_URDF.replacen("<axis xyz=\"0 0 1\"/>", "<axis xyz=\"0 0 q\"/>", 1);
    std::fs::write(folder.path().join("bad.urdf"), urdf).unwrap();
    refused(
        folder.path(),
        &["info", "bad.urdf"],
        "",
        &["bad.urdf:14:", "3 finite numbers"],
    );
    refused(
        folder.path(),
        &["info", robot, "--tip", "x"],
        "",
        &["--tip is for a URDF"],
    );
    refused(
        folder.path(),
        &["plan", robot, "--from", "ready"],
        "",
        &["--to"],
    );
    let from = ["plan", robot, "--from", "yoga", "--to", "stow"];
    refused(folder.path(), &from, "", &["--from yoga", "ready, stow"]);
    std::fs::write(folder.path().join("arm.urdf"), FLIGHT_URDF).unwrap();
    let plan = [
        "plan",
        "arm.urdf",
        "--from",
        "0,0,0,0,0",
        "--to",
        "1,0,0,0,0",
    ];
    refused(folder.path(), &plan, "", &["a plan needs a robot file"]);
}
