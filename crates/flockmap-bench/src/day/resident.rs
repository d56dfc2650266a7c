//! What the process takes of the machine's memory.

use serde::Serialize;

/// Bytes that are resident, now and at most so far.
#[derive(Clone, Copy, Serialize, Debug)]
pub struct Resident {
    pub now: u64,
    pub most: u64,
}

/// As the system says, where it does.
pub fn resident() -> Option<Resident> {
    of(&std::fs::read_to_string("/proc/self/status").ok()?)
}

fn of(status: &str) -> Option<Resident> {
    let bytes = |name: &str| {
        let line = status.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(':'))?;
        line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok().map(|kb| kb * 1_024)
    };
    Some(Resident { now: bytes("VmRSS")?, most: bytes("VmHWM")? })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_is_read_or_not_said() {
        let said = of("Name:\tday\nVmHWM:\t    3072 kB\nVmRSS:\t    2048 kB\n").unwrap();
        assert_eq!((said.now, said.most), (2 << 20, 3 << 20));
        for wrong in ["", "VmRSS: 5 kB", "VmRSS: 5 kB\nVmHWM: much kB", "VmRSS: 5 kB\nVmHWM: 7"] {
            assert!(of(wrong).is_none(), "{wrong}");
        }
    }
}
