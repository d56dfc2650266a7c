//! The epoch of a run: above all before whatever the clock shows and the file says, on every disk.

use std::sync::Arc;

use flockmap::RobotId;
use flockmap_store::memory::{Faults, MemoryDisk, PowerCut};
use flockmap_store::{EpochFault, EpochFile, EpochsExhausted, next_epoch};
use proptest::prelude::*;

const NAME: &str = "epoch-3-7";
const NOW: u64 = 1_790_000_000;

fn open(disk: &MemoryDisk) -> (EpochFile, Option<EpochFault>) {
    EpochFile::open(Arc::new(disk.clone()), 3, RobotId(7))
}

/// A start of the robot: its epoch, safe on disk.
fn boot(disk: &MemoryDisk, seconds: u64, random: u32) -> Result<u64, EpochsExhausted> {
    let (mut file, fault) = open(disk);
    assert!(fault.is_none(), "{fault:?}");
    let epoch = next_epoch(file.last(), seconds, random)?;
    file.keep(epoch).unwrap();
    Ok(epoch)
}

/// A disk with a sound file that says this.
fn disk_with(epoch: u64) -> MemoryDisk {
    let disk = MemoryDisk::default();
    open(&disk).0.keep(epoch).unwrap();
    disk
}

#[test]
fn an_epoch_is_the_time_above_a_random_number() {
    assert_eq!(next_epoch(None, NOW, 5), Ok(NOW << 32 | 5));
    assert_eq!(next_epoch(Some((NOW - 9) << 32 | 77), NOW, 5), Ok(NOW << 32 | 5));
    // The clock fell back, or shows the same second again.
    assert_eq!(next_epoch(Some(NOW << 32 | 77), NOW, 5), Ok((NOW + 1) << 32 | 5));
    assert_eq!(next_epoch(Some(NOW << 32 | 77), 0, 5), Ok((NOW + 1) << 32 | 5));
    // Without a disk, two runs at one reading of the clock differ.
    assert_ne!(next_epoch(None, 0, 5), next_epoch(None, 0, 6));
}

#[test]
fn a_clock_beyond_2106_is_not_believed_and_costs_no_later_start() {
    for seconds in [u64::from(u32::MAX), 1 << 32, 5_000_000_000, u64::MAX] {
        assert_eq!(next_epoch(None, seconds, 5), Ok(5), "{seconds}");
        let disk = disk_with(NOW << 32 | 9);
        let epoch = boot(&disk, seconds, 5).unwrap();
        assert_eq!(epoch, (NOW + 1) << 32 | 5, "{seconds}");
        // The clock is right again.
        assert_eq!(boot(&disk, NOW + 60, 5), Ok((NOW + 60) << 32 | 5));
    }
    // The last second that is believed.
    let disk = disk_with(NOW << 32);
    let last = u64::from(u32::MAX) - 1;
    assert_eq!(boot(&disk, last, u32::MAX), Ok(last << 32 | u64::from(u32::MAX)));
    assert!(boot(&disk, NOW, u32::MAX).unwrap() >> 32 == u64::from(u32::MAX));
}

proptest! {
    #[test]
    fn every_run_is_above_the_last_whatever_the_clock_shows(
        clocks in prop::collection::vec(
            prop_oneof![
                Just(0), Just(1), Just(NOW), NOW - 5..NOW + 5, Just(u64::from(u32::MAX) - 1),
                Just(u64::from(u32::MAX)), Just(1 << 32), Just(u64::MAX), any::<u64>(), 0..=u64::from(u32::MAX)
            ],
            1..60,
        ),
        first in prop_oneof![2 => Just(None), 1 => any::<u64>().prop_map(Some), 1 => (0..1_000_000u64).prop_map(|n| Some(u64::MAX - (1 << 32) + n))],
        randoms in prop::collection::vec(any::<u32>(), 60),
    ) {
        let disk = first.map_or_else(MemoryDisk::default, disk_with);
        let mut last = first;
        for (clock, random) in clocks.into_iter().zip(randoms) {
            let epoch = boot(&disk, clock, random).unwrap();
            prop_assert!(last.is_none_or(|last| epoch > last), "{last:?} then {epoch}");
            last = Some(epoch);
        }
    }
}

#[test]
fn where_the_high_bits_are_spent_the_low_ones_last_for_a_million_starts() {
    let mut last = u64::from(u32::MAX) << 32;
    let mut random = 1u32;
    for start in 0..1_000_000 {
        random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        let epoch = next_epoch(Some(last), NOW, if start % 2 == 0 { u32::MAX } else { random }).unwrap();
        assert!(epoch > last, "start {start}");
        last = epoch;
    }
    // Even at the worst, the last ones come one by one.
    assert_eq!(next_epoch(Some(u64::MAX - 2), NOW, u32::MAX), Ok(u64::MAX - 1));
    assert_eq!(next_epoch(Some(u64::MAX - 1), NOW, u32::MAX), Ok(u64::MAX));
}

#[test]
fn beyond_the_last_epoch_there_is_none_and_that_is_said() {
    let error = boot(&disk_with(u64::MAX), NOW, 1).unwrap_err();
    assert_eq!(error, EpochsExhausted);
    assert_eq!(error.to_string(), "the last run had epoch 18446744073709551615, and there is no higher one");
}

#[test]
fn the_file_is_as_the_documents_say() {
    let disk = disk_with(0x0102_0304_0506_0708);
    let mut expected = b"FLKEPOCH\x01\0\0\0\x03\0\x07\0\x08\x07\x06\x05\x04\x03\x02\x01".to_vec();
    expected.extend_from_slice(&crc32fast::hash(&expected).to_le_bytes());
    assert_eq!(disk.files(), [(NAME.to_owned(), expected)].into());
}

#[test]
fn a_lower_epoch_does_not_replace_a_higher_one() {
    let disk = disk_with(9 << 32);
    let (mut file, _) = open(&disk);
    file.keep(5 << 32).unwrap();
    assert_eq!(open(&disk).0.last(), Some(9 << 32));
}

#[test]
fn a_file_that_is_spoilt_at_any_byte_is_told_and_replaced_and_stops_no_start() {
    let sound = disk_with(9 << 32).files()[NAME].clone();
    let mut spoilt: Vec<Vec<u8>> = (0..sound.len()).map(|length| sound[..length].to_vec()).collect();
    for at in 0..sound.len() {
        for bit in 0..8 {
            let mut bytes = sound.clone();
            bytes[at] ^= 1 << bit;
            spoilt.push(bytes);
        }
    }
    spoilt.push([sound, vec![0]].concat());
    spoilt.push(vec![0xff; 100_000]);
    for bytes in spoilt {
        let disk = MemoryDisk::of([(NAME.to_owned(), bytes.clone())].into());
        let (mut file, fault) = open(&disk);
        let fault = fault.unwrap_or_else(|| panic!("{bytes:x?} was believed"));
        assert!(matches!(fault, EpochFault::Damaged { .. }), "{fault}");
        assert!(fault.to_string().starts_with(NAME) && fault.to_string().contains("written anew"), "{fault}");
        assert_eq!(file.last(), None);
        file.keep(4 << 32).unwrap();
        assert_eq!(boot(&disk, 0, 1), Ok(5 << 32 | 1));
    }
}

#[test]
fn the_file_of_another_robot_or_version_is_not_believed() {
    let fault = |change: &dyn Fn(&mut Vec<u8>)| {
        let mut bytes = disk_with(9 << 32).files()[NAME].clone();
        bytes.truncate(24);
        change(&mut bytes);
        bytes.extend_from_slice(&crc32fast::hash(&bytes).to_le_bytes());
        open(&MemoryDisk::of([(NAME.to_owned(), bytes)].into())).1.unwrap().to_string()
    };
    assert!(fault(&|bytes| bytes[14] = 8).contains("is of another robot"));
    assert!(fault(&|bytes| bytes[12] = 4).contains("is of another robot"));
    assert!(fault(&|bytes| bytes[8] = 2).contains("is of another version"));
}

#[test]
fn robots_of_a_machine_do_not_disturb_each_other() {
    let disk = disk_with(9 << 32);
    for (swarm, robot) in [(3, 8), (4, 7)] {
        let (mut file, fault) = EpochFile::open(Arc::new(disk.clone()), swarm, RobotId(robot));
        assert!(fault.is_none() && file.last().is_none());
        file.keep(50 << 32).unwrap();
    }
    assert_eq!(open(&disk).0.last(), Some(9 << 32));
}

#[test]
fn whichever_call_fails_or_is_the_last_an_epoch_that_was_kept_stays_known() {
    let cuts = [
        None,
        Some(PowerCut { bytes_kept: 0, names_kept: false }),
        Some(PowerCut { bytes_kept: 5, names_kept: false }),
        Some(PowerCut { bytes_kept: 5, names_kept: true }),
    ];
    let (old, new) = (9 << 32, 10 << 32);
    let mut hits = 0;
    for lasts in [false, true] {
        for cut in cuts {
            for call in 0.. {
                let disk = disk_with(old);
                // What a crash left.
                disk.put("epoch-3-7.new", vec![1, 2]);
                let begin = disk.calls() + call;
                let calls = begin..if lasts { u64::MAX } else { begin + 1 };
                disk.set_faults(Faults { calls, ..Faults::default() });
                let (mut file, read) = open(&disk);
                let kept = file.keep(new);
                let is_hit = disk.calls() > begin;
                disk.set_faults(Faults::default());
                if let Some(cut) = cut {
                    disk.cut_power(cut);
                }
                let (again, fault) = open(&disk);
                let what = format!("call {call}, lasts {lasts}, {cut:?}, {read:?}, {kept:?}");
                assert!(fault.is_none(), "{what}: {fault:?}");
                assert!(
                    again.last() == Some(new) || kept.is_err() && again.last() == Some(old),
                    "{what}: {:?}",
                    again.last()
                );
                // And it can be gone on with.
                boot(&disk, NOW, 1).unwrap();
                if !is_hit {
                    break;
                }
                hits += 1;
            }
        }
    }
    println!("{hits} calls have failed");
    assert!(hits > 40);
}
