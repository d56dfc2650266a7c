//! `flockmap radio`: what it does to datagrams, and five robots that talk through it
//! (`tests/netns/five_nodes.sh`).
#![cfg(target_os = "linux")]

mod common;

use std::io::{BufRead, BufReader, Write};
use std::net::{SocketAddr, UdpSocket};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::time::{Duration, Instant};

use common::{fails, json};

/// A socket of a robot, and the radio between three of them.
struct Desk {
    robots: Vec<UdpSocket>,
    /// Where each robot appears to the others.
    seen_at: Vec<SocketAddr>,
    radio: Child,
    say: ChildStdin,
    lines: std::io::Lines<BufReader<std::process::ChildStdout>>,
}

impl Desk {
    fn new(words: &str) -> Self {
        let robots: Vec<UdpSocket> = (0..3).map(|_| UdpSocket::bind("127.0.0.1:0").unwrap()).collect();
        // A row of ports that is free: the system knows one, the next ones are tried.
        for attempt in 0..20 {
            let port = UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
            let port = if port > 65_000 { port - 1_000 } else { port } + attempt;
            let mut radio = Command::new(env!("CARGO_BIN_EXE_flockmap"))
                .arg("radio")
                .args(robots.iter().map(|robot| robot.local_addr().unwrap().to_string()))
                .args(["--listen", &format!("127.0.0.1:{port}")])
                .args(words.split_whitespace())
                .stdin(Stdio::piped())
                .stdout(Stdio::piped())
                .spawn()
                .unwrap();
            let say = radio.stdin.take().unwrap();
            let mut lines = BufReader::new(radio.stdout.take().unwrap()).lines();
            if lines.by_ref().map_while(Result::ok).any(|line| line == "the radio is on") {
                let seen_at = (1..=3).map(|n| SocketAddr::from(([127, 0, 0, 1], port + n))).collect();
                for robot in &robots {
                    robot.set_read_timeout(Some(Duration::from_secs(5))).unwrap();
                }
                return Self { robots, seen_at, radio, say, lines };
            }
            radio.wait().unwrap();
        }
        panic!("no free ports");
    }

    /// Robot `from` sends to robot `to`; both count from 1.
    fn send(&self, from: usize, to: usize, text: &str) {
        self.robots[from - 1].send_to(text.as_bytes(), self.seen_at[to - 1]).unwrap();
    }

    /// What robot `to` gets next, and from which robot as it seems.
    fn get(&self, to: usize) -> Option<(usize, String)> {
        let mut buffer = [0; 100];
        let (length, from) = self.robots[to - 1].recv_from(&mut buffer).ok()?;
        let from = self.seen_at.iter().position(|at| *at == from).expect("it comes through the radio") + 1;
        Some((from, String::from_utf8_lossy(&buffer[..length]).into_owned()))
    }

    /// Gives a command, and waits until it is carried out.
    fn say(&mut self, command: &str, echo: &str) {
        writeln!(self.say, "{command}").unwrap();
        self.line(echo);
    }

    /// The next line of the radio that has this in it.
    fn line(&mut self, part: &str) -> String {
        self.lines.by_ref().map_while(Result::ok).find(|line| line.contains(part)).expect("the radio says so")
    }

    /// Waits until a robot has so many datagrams in this column of the table.
    fn wait_for(&mut self, robot: usize, column: Column, count: u64) {
        loop {
            self.say("status", "Status");
            let row = self.line(&format!("  {robot} at "));
            let cell = row.split_whitespace().nth(column as usize).expect("all columns are there");
            if cell.replace(',', "") == count.to_string() {
                return;
            }
        }
    }
}

/// Columns of the table, after the three parts that name the robot.
#[derive(Clone, Copy)]
enum Column {
    SentBytes = 3,
    Lost = 8,
}

impl Drop for Desk {
    fn drop(&mut self) {
        // It may have ended already.
        let _ = self.radio.kill();
        let _ = self.radio.wait();
    }
}

#[test]
fn robots_talk_through_the_radio_late_and_by_command_not_at_all() {
    let mut desk = Desk::new("--delay-ms 40");
    let began = Instant::now();
    desk.send(1, 2, "hello");
    assert_eq!(desk.get(2), Some((1, "hello".into())));
    assert!(began.elapsed() >= Duration::from_millis(40), "{:?}", began.elapsed());

    desk.say("split 1,2/3", "Split");
    desk.send(1, 3, "lost");
    desk.wait_for(3, Column::Lost, 1);
    desk.say("heal", "Heal");
    desk.send(1, 3, "heard");
    assert_eq!(desk.get(3), Some((1, "heard".into())), "nothing passes a split");

    desk.say("cut 3>1", "Cut");
    desk.send(3, 1, "lost");
    desk.wait_for(1, Column::Lost, 1);
    desk.send(1, 3, "one direction");
    assert_eq!(desk.get(3), Some((1, "one direction".into())));
    desk.say("join all", "Join");
    desk.send(3, 1, "again");
    assert_eq!(desk.get(1), Some((3, "again".into())));

    writeln!(desk.say, "end").unwrap();
    assert!(desk.radio.wait().unwrap().success());
}

#[test]
fn the_radio_loses_its_share_and_counts_all() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("radio.json");
    let mut desk = Desk::new(&format!(
        "--loss 0.3 --duplication 0.1 --bit-flips 0.2 --seed 3 --json {}",
        path.display()
    ));
    let stranger = UdpSocket::bind("127.0.0.1:0").unwrap();
    stranger.send_to(b"who?", desk.seen_at[0]).unwrap();
    let (mut got, mut flipped) = (0, 0);
    for batch in 0..20 {
        // So few that no queue of the system overflows.
        for n in 0..50 {
            desk.send(1, 2, &format!("{:030}", 50 * batch + n));
        }
        desk.wait_for(1, Column::SentBytes, 50 * (batch + 1));
        // What was on the air is through before the radio takes the next command.
        desk.wait_for(1, Column::SentBytes, 50 * (batch + 1));
        desk.robots[1].set_nonblocking(true).unwrap();
        while let Some((from, text)) = desk.get(2) {
            assert_eq!(from, 1);
            got += 1;
            flipped += u64::from(!text.parse::<u64>().is_ok_and(|number| number < 1_000));
        }
    }
    writeln!(desk.say, "end").unwrap();
    assert!(desk.radio.wait().unwrap().success());
    let report = json(&path);
    let (sender, receiver) = (&report["robots"][0], &report["robots"][1]);
    assert_eq!((&sender["sent"], &report["from_strangers"]), (&1_000.into(), &1.into()));
    let (lost, received) = (receiver["lost"].as_u64().unwrap(), receiver["received"].as_u64().unwrap());
    assert_eq!(received, got, "what the radio says was received has arrived");
    // 300 ± 6 standard deviations; 1.1 copies of each of the others, and a fifth of these with a wrong bit.
    assert!((213..=387).contains(&lost), "{lost} lost");
    assert!(
        received > 1_000 - lost + 20 && received < 1_000 - lost + 130,
        "{received} received, {lost} lost"
    );
    let wrong = receiver["wrong_bit"].as_u64().unwrap();
    assert!((80..=240).contains(&wrong) && flipped <= wrong && flipped > 20, "{wrong} wrong, {flipped} seen");
}

#[test]
fn words_that_make_no_sense_are_named() {
    let error = fails("radio 127.0.0.1:7701");
    assert!(error.contains("2 values") || error.contains("ADDRESS:PORT"), "{error}");
    let error = fails("radio 127.0.0.1:7701 127.0.0.1:7701");
    assert!(error.contains("given twice"), "{error}");
    let error = fails("radio 127.0.0.1:7701 0.0.0.0:7702");
    assert!(error.contains("0.0.0.0:7702"), "{error}");
    let error = fails("radio 127.0.0.1:7701 127.0.0.1:7702 --loss 1.5");
    assert!(error.contains("0 to 1"), "{error}");
    let error = fails("radio 127.0.0.1:7701 127.0.0.1:7702 --listen 127.0.0.1:65534");
    assert!(error.contains("65536") || error.contains("65,536"), "{error}");
}

/// Shorter than the script by itself, which takes a minute and a half with a split of 20 s.
#[test]
fn five_nodes_on_a_bad_radio_end_with_equal_maps_after_a_split_and_a_kill() {
    let folder = tempfile::tempdir().unwrap();
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/netns/five_nodes.sh");
    let output = Command::new("sh")
        .arg(script)
        .arg(env!("CARGO_BIN_EXE_flockmap"))
        .arg(folder.path())
        .envs([
            ("FLIGHT_S", "10"),
            ("SPLIT_AT_S", "2"),
            ("SPLIT_S", "5"),
            ("KILL_AT_S", "3"),
            ("DOWN_S", "2"),
        ])
        .env("QUIET_S", "12")
        .output()
        .unwrap();
    println!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success());
    let report = json(&folder.path().join("radio.json"));
    for robot in report["robots"].as_array().unwrap() {
        let (lost, received) = (robot["lost"].as_u64().unwrap(), robot["received"].as_u64().unwrap());
        assert!(received > 50 && lost * 5 > lost + received, "the radio was bad: {robot}");
    }
}
