# Makes Doxygen's comments of those of include/bakelite.h: a ruled section becomes a group that holds all up to the next
# one, and a comment in front of an item its documentation. Comments that Doxygen reads already stay as they are.

NR == 1 && /^\/\*$/ { print "/** @file"; next }
/^\/\* =====/ {
    if (open) print "/** @} */"
    getline
    sub(/^ \* */, "")
    printf "/** @defgroup section%02d %s\n", ++sections, $0
    open = in_section = 1
    next
}
in_section && /^ \* =====/ { print " * @{ */"; in_section = 0; next }
/^#ifdef __cplusplus/ && open { print "/** @} */"; open = 0 }
/^ *\/\/( |$)/ { sub(/\/\//, "///") }
{ print }
