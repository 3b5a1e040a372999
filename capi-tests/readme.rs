//! What the README shows is what the tests compile.

#[test]
fn the_c_example_of_the_readme_is_example_c() {
    let readme = include_str!("../README.md");
    let block = readme.split("```c\n").nth(1).and_then(|rest| rest.split("```").next());
    assert_eq!(block, Some(include_str!("example.c")));
}
