"""Files written whole or not at all, and locks on outputs."""

import errno

DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Error numbers of a full disk, an exhausted quota or a limit on file sizes."""
