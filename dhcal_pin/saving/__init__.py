"""Saving: the files of a run are written all or none, whatever happens in between.

`write_files` is the only function that writes results. Its order is

1. lock the folders, complete the commit of a run that was killed there, remove its temporary files;
2. write every content to a temporary file in the folder of its target, and flush it to the disk;
3. write to devices, pipes and standard output, which cannot be replaced;
4. write a record of the renames: from now on the run is committed;
5. rename the temporary files to their targets and remove the record.

A run that is killed before step 4 has changed no target. If it is killed later, the next command that reads a
robot or writes files in one of the folders completes it. Interrupts wait until the files are saved.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
