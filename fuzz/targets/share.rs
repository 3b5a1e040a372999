#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| bakelite_fuzz::damaged_files::read("share", bytes));
