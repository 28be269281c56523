#!/bin/sh
# Where pages are run there is one user, who may do everything.
exec "$@"
