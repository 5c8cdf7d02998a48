//! The paper's table 1, complete: three levels, 196 targets, 100 independent draws each, 58 800
//! trials with the errors before and after one, two and three corrections.

#![allow(clippy::expect_used, missing_docs)]

use criterion::{Criterion, criterion_group, criterion_main};
use rover_study::{
    StudyConfig,
    table1::{PAPER_TRIALS, prepared, rows},
};
use std::hint::black_box;

fn whole_table(c: &mut Criterion) {
    let targets = prepared().expect("the workspace holds the targets");
    for threads in [1, 2] {
        let config = StudyConfig::new(1, PAPER_TRIALS, Some(threads));
        let pool = config.pool().expect("threads");
        c.bench_function(&format!("table1, {threads} thread(s)"), |b| {
            b.iter(|| pool.install(|| rows(black_box(&config), &targets).expect("a table")));
        });
    }
}

criterion_group!(benches, whole_table);
criterion_main!(benches);
