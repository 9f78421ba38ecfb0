"""The studio: a page in the browser where regions are placed and parts are seen growing.

`Session` holds all that there is to know and do, without a browser; `view` shows it by means of viser; `queue` runs
edits as processes of their own, which tell what they do through files in their run folders.
"""
