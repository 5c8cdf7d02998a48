//! The `rover` command.

use std::process::ExitCode;

fn main() -> ExitCode {
    rover::commands::main()
}
