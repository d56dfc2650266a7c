//! The ABI as C sees it: what the header says of every function, and that the tests in C++ know all of them.

use std::collections::BTreeSet;
use std::ffi::CStr;
use std::ptr::null_mut;

use flockmap::*;

const HEADER: &str = include_str!("../include/flockmap.h");
const NULLS: &str = include_str!("errors.cpp");
const WRAPPER: &str = include_str!("../include/flockmap.hpp");

/// Each function of the header: its comment, its name, and what it takes.
fn functions() -> Vec<(String, String, String)> {
    let mut all = Vec::new();
    let mut comment = String::new();
    let body = HEADER.split("extern \"C\" {").nth(1).expect("declarations");
    let mut lines = body.lines();
    while let Some(line) = lines.next() {
        if let Some(text) = line.strip_prefix("//") {
            comment += text;
            continue;
        }
        if let Some(at) = line.find("flockmap_").filter(|_| line.contains('(')) {
            let mut declaration = line[at..].to_owned();
            while !declaration.ends_with(';') {
                declaration += lines.next().expect("the rest of a declaration");
            }
            // The type of the result, where it begins with the same word.
            let from = declaration[..declaration.find('(').expect("(")].rfind("flockmap_").expect("a name");
            let (name, arguments) = declaration[from..].split_once('(').expect("(");
            all.push((std::mem::take(&mut comment), name.to_owned(), arguments.to_owned()));
        }
        comment.clear();
    }
    all
}

#[test]
fn every_function_says_who_may_call_it() {
    let functions = functions();
    assert!(functions.len() > 45, "{}", functions.len());
    for (comment, name, _) in functions {
        let says = comment.contains("Any thread")
            || comment.contains("No other thread")
            || comment.contains("As flockmap_")
            || comment.contains("as for")
            || comment.contains("The same for")
            || comment.contains("this thread");
        assert!(says, "{name}: {comment}");
    }
}

#[test]
fn the_test_of_nulls_and_the_c_plus_plus_layer_know_every_function() {
    for (_, name, arguments) in functions() {
        let takes_a_pointer = arguments.contains('*');
        assert!(!takes_a_pointer || NULLS.contains(&format!("{name}(")), "{name} is not called with null");
        // A function without a wrapper is not for users of C++, or was forgotten.
        let is_plain =
            ["flockmap_result_name", "flockmap_version", "flockmap_epoch"].contains(&name.as_str());
        assert!(is_plain || WRAPPER.contains(&name), "{name} is not in flockmap.hpp");
    }
}

#[test]
fn names_are_unique_and_versions_agree() {
    let all = functions();
    let names: BTreeSet<&String> = all.iter().map(|(_, name, _)| name).collect();
    assert_eq!(names.len(), all.len());
    // SAFETY: static, and ends with a 0.
    let version = unsafe { CStr::from_ptr(flockmap_version()) }.to_str().unwrap();
    let mut parts = version.split('.');
    for part in ["MAJOR", "MINOR", "PATCH"] {
        let line = format!("#define FLOCKMAP_VERSION_{part} {}\n", parts.next().unwrap());
        assert!(HEADER.contains(&line), "{line}");
    }
}

#[test]
fn options_that_say_nothing_make_the_default_robot() {
    // SAFETY: plain numbers, of which the library writes all.
    let mut options: Options = unsafe { std::mem::zeroed() };
    let mut robot = null_mut();
    // SAFETY: pointers to what lives.
    unsafe {
        assert_eq!(flockmap_robot_options_default(&mut options), Outcome::Ok);
        assert_eq!(flockmap_robot_new(&options, 0, &mut robot), Outcome::Ok);
        flockmap_robot_free(robot);
    }
    assert_eq!((options.resolution_m, options.range_m, options.id), (0.1, 7.0, 1));
}
