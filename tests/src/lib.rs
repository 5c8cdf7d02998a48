//! Tests across crates: end to end, determinism, faults and the network contract, all on the
//! `rover` command as users run it. Nothing else is here; see `tests/`.
