//! Speed of the physics and of whole control steps: arm, driver, switch, terrain.
#![allow(clippy::unwrap_used, missing_docs)]

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use rover_kinematics::through;
use rover_messages::{
    arm::Guard,
    mobility::{DriveArc, DriveGoal, DriveGuard},
};
use rover_robot::Robot;
use rover_sim::{RockDescription, SimulationDescription, World};
use std::sync::Arc;

fn world() -> World {
    let text = include_str!("../../scenarios/robots/bluestreak.toml");
    let robot = Arc::new(Robot::parse(text, "bluestreak.toml").unwrap());
    let start = robot.posture("ready").unwrap().to_vec();
    let mut description = SimulationDescription::default();
    description.terrain.height_m = 0.25;
    description.terrain.rocks = vec![RockDescription {
        position_m: [0.54, 0.0, 0.27],
        ..RockDescription::default()
    }];
    World::new(robot, &description, 1, &start).unwrap()
}

fn steps(criterion: &mut Criterion) {
    const PERIODS: u32 = 50;
    let mut world = world();
    let steps = u64::from(PERIODS) * world.steps_per_period();
    let mut group = criterion.benchmark_group("control_steps");
    group.throughput(Throughput::Elements(steps));
    group.bench_function("holding", |b| b.iter(|| world.advance(PERIODS)));
    let robot = world.robot().clone();
    let (ready, stow) = (
        robot.posture("ready").unwrap(),
        robot.posture("stow").unwrap(),
    );
    let mut to_stow = true;
    group.bench_function("moving", |b| {
        b.iter(|| {
            if !world.is_moving() {
                let ends = if to_stow {
                    [ready, stow]
                } else {
                    [stow, ready]
                };
                to_stow = !to_stow;
                let path = ends.map(<[f64]>::to_vec);
                world
                    .start(through(&robot.arm, &path, 1.0).unwrap(), Guard::default())
                    .unwrap();
            }
            world.advance(PERIODS)
        });
    });
    group.finish();
}

/// The Rocky 8 on undulating ground with rocks, a metre forth and back.
fn driving(criterion: &mut Criterion) {
    const PERIODS: u32 = 3;
    let text = include_str!("../../scenarios/robots/rocky8.toml");
    let robot = Arc::new(Robot::parse(text, "rocky8.toml").unwrap());
    let start = robot.posture("stow").unwrap().to_vec();
    let mut description = SimulationDescription::default();
    let terrain = &mut description.terrain;
    terrain.rocks.clear();
    terrain.centre_m = [2.0, 0.0];
    terrain.size_m = [8.0, 6.0];
    terrain.cell_m = 0.025;
    terrain.relief_m = 0.02;
    terrain.relief_wavelength_m = 2.0;
    terrain.scattered.count_n = 160;
    let mut world = World::new(robot, &description, 1, &start).unwrap();
    let mut forth = true;
    let mut set_off = |world: &mut World| {
        let goal = DriveGoal {
            arc: DriveArc::Arc {
                length_m: if forth { 1.0 } else { -1.0 },
                curvature_1_m: 0.0,
            },
            speed_fraction: 1.0,
            guard: DriveGuard::default(),
        };
        forth = !forth;
        world.start_drive(&goal).unwrap();
    };
    set_off(&mut world);
    let steps = u64::from(PERIODS) * world.steps_per_period();
    let mut group = criterion.benchmark_group("control_steps");
    group.throughput(Throughput::Elements(steps));
    group.bench_function("driving", |b| {
        b.iter(|| {
            if !world.is_moving() {
                set_off(&mut world);
            }
            world.advance(PERIODS)
        });
    });
    group.finish();
}

criterion_group!(benches, steps, driving);
criterion_main!(benches);
