"""Parts of [print_recovery]: the file it keeps, and the search for the place where a print stopped."""
